#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Installs what only the benchmarks' peers need: .venv-bench with the packages of requirements-bench.txt, by
# hash (Mitsuba 3 for bench-sim; scikit-learn, m2cgen, emlearn and micromlgen for bench-inference), and
# Debian's libllvm19, with which alone Mitsuba 3.9 runs. `make setup` and `make test` never come here. A
# second run does nothing.
#
#   usage: sh tools/bench/setup_bench.sh [--without-llvm]     what bench-inference needs; no apt
#
#   PYTHON    the interpreter that .venv-bench is made with (python3)
#
# Exit: 0 all there; 1 something is missing, with the line that says how to get it.
set -eu
cd "$(dirname "$0")/../.."
python=${PYTHON:-python3}
venv=.venv-bench

say() { echo "setup-bench: $*"; }
die() { echo "setup-bench: $*" >&2; exit 1; }

has_llvm() {
    [ -n "${DRJIT_LIBLLVM_PATH:-}" ] || ls /usr/lib/*/libLLVM.so.19.1 >/dev/null 2>&1 ||
        ls /usr/lib/llvm-19/lib/libLLVM.so* >/dev/null 2>&1
}

mkdir -p build/setup
if [ "${1:-}" != --without-llvm ] && ! has_llvm; then
    sudo=sudo
    if [ "$(id -u)" = 0 ]; then
        sudo=
    elif ! sudo -n true 2>/dev/null; then
        die "run first: sudo apt-get update && sudo apt-get install libllvm19"
    fi
    say "installing Debian's libllvm19"
    $sudo apt-get -q update >build/setup/apt-bench.log 2>&1 || true
    $sudo env DEBIAN_FRONTEND=noninteractive apt-get -q -y -o DPkg::Lock::Timeout=300 install \
        --no-install-recommends libllvm19 >>build/setup/apt-bench.log 2>&1 ||
        die "apt-get failed (see build/setup/apt-bench.log); set DRJIT_LIBLLVM_PATH to an LLVM 19 library"
fi

stamp=$( { cat requirements-bench.txt tools/bench/setup_bench.sh; pwd; "$python" -VV; } | sha256sum)
if [ -f $venv/setup-stamp ] && [ "$(cat $venv/setup-stamp)" = "$stamp" ]; then
    exit 0
fi
say "installing the packages of requirements-bench.txt into $venv"
"$python" -m venv --clear $venv
printf "*\n" >$venv/.gitignore
# micromlgen has no wheel. It is built with the pinned setuptools, which therefore comes first: pip's own
# build environment would fetch one without a hash.
awk '/^[a-z]/ { own = /^setuptools==/ } own' requirements-bench.txt >build/setup/bench-first.txt
install() {
    $venv/bin/python -m pip install -qq --disable-pip-version-check --no-input --only-binary :all: \
        --require-hashes "$@" || die "pip could not install requirements-bench.txt: see above"
}
install -r build/setup/bench-first.txt
install --no-build-isolation --no-binary micromlgen -r requirements-bench.txt
echo "$stamp" >$venv/setup-stamp
say "done"
