# SPDX-License-Identifier: Apache-2.0
# The one entry point; CI runs `make test`. `make` alone lists what there is.
#
#   SEED=k       the simulated person, parts and noise of `make demo`; SEEDS="..." those of `make seeds`
#   ARGS="..."   handed on: to tools/demo.py by `make demo`, to pytest by `make test`, to tools/bench by
#                `make bench-...`
#   PYTHON=...   the interpreter that .venv is made with

SHELL := /bin/sh
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:

SEED ?= 1
SEEDS ?= 1 2 3 4 5 6 7 8 9 10
ARGS ?=
PY := .venv/bin/python
SDK := host_sdk/sparsegaze
HEX := $(SDK)/data/firmware.hex
PIO := .pio/build/nano
BINUTILS := .pio-offline/packages/toolchain-atmelavr/bin
M4 := firmware/ports/mps2an386
M4_CC := arm-none-eabi-gcc
M4_FLAGS := -mcpu=cortex-m4 -mthumb -std=gnu11 -O2 -Wall -Wextra -Werror -ffreestanding -ffunction-sections
STARTED := $(shell date +%s.%N)
FRESH := $(if $(wildcard .venv/setup-stamp),,--fresh)

# The command $(1), which speaks only when it fails.
quietly = echo "$(1)"; { $(1); } >build/native/log 2>&1 || { cat build/native/log >&2; exit 1; }
# $(1) over $(2) when it differs, at one stroke because somebody may be reading; then the command $(3).
refresh = cmp -s $(1) $(2) || { cp $(1) $(2).new && mv $(2).new $(2) && $(if $(3),$(3),:); }

.PHONY: help setup firmware native demo seeds test bench-sim bench-inference bench-frontend check size lock
.PHONY: clean distclean

help: ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/  make \1#\2/p' $(MAKEFILE_LIST) | \
	    awk -F'#' '{ printf "%-24s%s\n", $$1, $$2 }'

setup: ## install what is missing: Debian packages (when root or sudo), .venv with pinned packages
	@sh tools/setup.sh

firmware: setup build/firmware/cortex-m4.elf ## build it for Nano and Cortex-M4; the hex goes into the package
	@$(PY) tools/pio_offline.py run -s -e nano
	@$(PY) tools/check_link.py $(PIO)/firmware.elf
	@mkdir -p build/firmware $(dir $(HEX))
	@$(call refresh,$(PIO)/firmware.elf,build/firmware/firmware.elf)
	@$(call refresh,$(PIO)/firmware.hex,build/firmware/firmware.hex)
	@$(call refresh,$(PIO)/firmware.hex,$(HEX),echo "$(HEX) changed: commit it together with the sources")

# No C library: what is linked is what is in firmware/.
build/firmware/cortex-m4.elf: Makefile \
    $(wildcard firmware/core/*.[ch] firmware/app/*.[ch] $(M4)/* $(M4)/include/*)
	@mkdir -p $(dir $@)
	@$(M4_CC) $(M4_FLAGS) -nostdinc -isystem "$$($(M4_CC) -print-file-name=include)" \
	    $(addprefix -I,$(M4)/include firmware/core firmware/app $(M4)) -nostdlib \
	    -T $(M4)/port.ld -Wl,--gc-sections,--fatal-warnings $(filter %.c,$^) -o $@.new
	@$(PY) tools/check_link.py $@.new && mv $@.new $@

native: setup build/native/core build/native/sim ## build what runs here: core, simulator, virtual Nano
	@$(MAKE) -s --no-print-directory -C tools/vheadset

# setup has built the core too, under setuptools' name for it: only one may stay, the other gets stale.
build/native/core: $(wildcard firmware/core/*.[ch] $(SDK)/_core_b*.[pc]*) firmware/app/app_rate.c \
    .venv/setup-stamp
	@mkdir -p $(dir $@)
	@$(call quietly,$(PY) $(SDK)/_core_build.py) && rm -f $(SDK)/_core.abi3.so && touch $@

build/native/sim: $(wildcard sim_c/*.[ch] sim_c/*.glsl $(SDK)/_sim_build.py) .venv/setup-stamp
	@mkdir -p $(dir $@)
	@$(call quietly,$(PY) $(SDK)/_sim_build.py) && touch $@

.venv/setup-stamp: | setup

demo: setup firmware native ## the whole main job on a virtual Nano; SEED=k draws another person
	@$(PY) tools/demo.py --seed $(SEED) --started $(STARTED) $(FRESH) $(ARGS)

seeds: setup firmware native ## the demo on many persons: make seeds SEEDS="1 2 3"
	@$(PY) tools/seeds.py $(SEEDS)

test: setup firmware native ## every test; ARGS="-k name" for some
	@$(PY) -m pytest $(ARGS)

bench-sim: setup native ## the simulator's speed against its error, with peers; ARGS="--quick --no-peers"
	@sh tools/bench/setup_bench.sh
	@$(PY) tools/bench/bench_sim.py $(ARGS)

bench-inference: setup firmware native ## cycles on the device against error, peers; ARGS="--quick --no-peers"
	@sh tools/bench/setup_bench.sh --without-llvm
	@$(PY) tools/bench/bench_inference.py $(ARGS)

bench-frontend: setup firmware native ## the front end: rate, latency, noise, ambient light; ARGS="--quick"
	@$(PY) tools/bench/bench_frontend.py $(ARGS)

check: firmware ## the quick static checks: includes, licences, packaging, link
	@$(PY) tests/check_includes.py
	@$(PY) -m pytest -q tests/build $(ARGS)

size: firmware ## flash and SRAM that the firmware takes, by section and by largest symbol
	@$(BINUTILS)/avr-size -A -d build/firmware/firmware.elf
	@$(BINUTILS)/avr-nm -S --size-sort -r -t d build/firmware/firmware.elf | head -n 20
	@$(PY) tools/bench/frontend_size.py

lock: ## write requirements.txt and requirements-bench.txt anew from their .in, with hashes
	@python3 -m venv build/lock && build/lock/bin/pip install -qq uv
	@build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
	    -o requirements.txt requirements.in
	@build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
	    -o requirements-bench.txt requirements-bench.in

clean: ## remove everything built; .venv stays
	@rm -rf build .pio .pio-offline $(SDK)/*.so $(SDK)/_core.c $(SDK)/_sim.c $(SDK)/*.o host_sdk/*.egg-info
	@if [ -f tools/vheadset/Makefile ]; then $(MAKE) --no-print-directory -C tools/vheadset clean; fi

distclean: clean ## remove .venv and .venv-bench as well
	@rm -rf .venv .venv-bench
