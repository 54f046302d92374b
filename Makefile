# SPDX-License-Identifier: Apache-2.0
# The one entry point; CI runs `make test`. `make` alone lists what there is.
#
#   SEED=k       the simulated person, parts and noise of `make demo`
#   ARGS="..."   handed on: to tools/demo.py by `make demo`, to pytest by `make test`
#   PYTHON=...   the interpreter that .venv is made with

SHELL := /bin/sh
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:

SEED ?= 1
ARGS ?=
PY := .venv/bin/python
SDK := host_sdk/sparsegaze
HEX := $(SDK)/data/firmware.hex
STARTED := $(shell date +%s.%N)

.PHONY: help setup firmware native demo test check size lock clean distclean

help: ## this list
	@sed -n 's/^\([a-z]*\):[^#]*## \(.*\)/  make \1#\2/p' $(MAKEFILE_LIST) | awk -F'#' '{ printf "%-18s%s\n", $$1, $$2 }'

setup: ## install what is missing: Debian packages (when root or sudo), .venv with pinned packages
	@sh tools/setup.sh

firmware: setup ## build the Nano's firmware with PlatformIO, check its link, put the hex into the Python package
	@$(PY) tools/pio_offline.py run -s -e nano
	@$(PY) tools/check_link.py .pio/build/nano/firmware.elf
	@mkdir -p build/firmware $(dir $(HEX))
	@for f in firmware.elf firmware.hex; do \
	    cmp -s .pio/build/nano/$$f build/firmware/$$f || { \
	        cp .pio/build/nano/$$f build/firmware/$$f.new && mv build/firmware/$$f.new build/firmware/$$f; }; done
	@cmp -s build/firmware/firmware.hex $(HEX) || { cp build/firmware/firmware.hex $(HEX).new && mv $(HEX).new $(HEX) && \
	    echo "$(HEX) changed: commit it together with the sources"; }

native: setup build/native/core build/native/sim ## build what runs on this computer: core and simulator for Python, virtual Nano
	@$(MAKE) --no-print-directory -C tools/vheadset

build/native/core: $(wildcard firmware/core/*.[ch] $(SDK)/_core_build.py $(SDK)/_core_batch.c) .venv/setup-stamp
	$(PY) $(SDK)/_core_build.py >build/native.log 2>&1 || { cat build/native.log >&2; exit 1; }
	@mkdir -p $(dir $@) && touch $@

build/native/sim: $(wildcard sim_c/*.[ch] $(SDK)/_sim_build.py) .venv/setup-stamp
	$(PY) $(SDK)/_sim_build.py >build/native.log 2>&1 || { cat build/native.log >&2; exit 1; }
	@mkdir -p $(dir $@) && touch $@

.venv/setup-stamp: | setup

demo: setup firmware native ## the whole main job on a virtual Nano; SEED=k draws another person, parts and noise
	@$(PY) tools/demo.py --seed $(SEED) --started $(STARTED) $(ARGS)

test: setup firmware native ## every test; ARGS="-k name" for some
	@$(PY) -m pytest $(ARGS)

check: firmware ## the quick static checks: includes, licences, packaging, link
	@$(PY) tests/check_includes.py
	@$(PY) -m pytest -q tests/build $(ARGS)

size: firmware ## flash and SRAM that the firmware takes, by section and by largest symbol
	@.pio-offline/packages/toolchain-atmelavr/bin/avr-size -A -d build/firmware/firmware.elf
	@.pio-offline/packages/toolchain-atmelavr/bin/avr-nm -S --size-sort -r -t d build/firmware/firmware.elf | head -n 20

lock: ## write requirements.txt anew from requirements.in, with hashes
	@python3 -m venv build/lock && build/lock/bin/pip install -qq uv
	@build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
	    -o requirements.txt requirements.in

clean: ## remove everything built; .venv stays
	@rm -rf build .pio .pio-offline $(SDK)/*.so $(SDK)/_core.c $(SDK)/_sim.c $(SDK)/*.o host_sdk/*.egg-info
	@if [ -f tools/vheadset/Makefile ]; then $(MAKE) --no-print-directory -C tools/vheadset clean; fi

distclean: clean ## remove .venv as well
	@rm -rf .venv
