# SPDX-License-Identifier: Apache-2.0
"""Cycles, stack, flash and RAM of the shipped binary against tests/budget.csv."""

import subprocess

import numpy as np
import pytest

from budget import judge_all
from conftest import collect, costly_model, random_features, random_model

from sparsegaze.model import FLAG_OUT_OF_RANGE

TARGET = "atmega328p"
CYCLES_PER_US = 16
RAM_BYTES = 2048
RAM_SPARE = 205                 # a tenth that nothing ever touches
PROGRAM_BYTES = 0x6C00          # the model slots lie above
VECTORS = 24
# What an interrupt costs outside of its markers: entry, jump, registers and flags saved and got back, return.
ISR_EDGES_CYCLES = 41
SECTIONS = {"infer": "0", "feature": "1", "output": "2", "sense_isr": "3", "serial_isr": "4", "frame": "5"}


@pytest.fixture
def costly(board, tmp_path):
    """A board that streams as fast as it can; every frame evaluates all kernels, guards and a correction.

    (VirtualNano, Device, model)
    """
    nano, device = board(models={}, state_dir=tmp_path / "looking")
    nano.control.motion(False)
    device.set_stream(raw=True)
    middle = np.median([frame.raw.feature for frame in collect(device, 1400, 3.0) if frame.raw][600:], axis=0)
    device.close()
    nano.stop()
    model = costly_model(middle, VECTORS)
    nano, device = board(models={0: model.image})
    nano.control.motion(False)
    device.recentre((0.5, -0.5), [[0.05, -0.02], [0.01, 0.03]])
    device.set_stream(gaze=True)
    device.link.sleep(1.0)
    device.link.flush_input()
    nano.control.markers_clear()
    return nano, device, model


def test_cycles_of_every_section_while_the_costliest_ordinary_model_streams(costly):
    """At the rate limit that the device states itself, no frame is lost and no slot is late."""
    nano, device, model = costly
    before, settings = device.status(), device.settings()
    frames = collect(device, 1010, 3.0)[10:]    # the first came with the answer that began the stream
    assert np.mean([not frame.gaze.flags & FLAG_OUT_OF_RANGE for frame in frames]) > 0.9, \
        "the model does not sit where the eye looks"
    sections, after = nano.control.markers(), device.status()
    period = settings.frame_period_us * CYCLES_PER_US
    net = {name: sections[f"{key}n"] for name, key in SECTIONS.items() if f"{key}n" in sections}
    for name, section in net.items():
        print(f"{name}: {section.least:.0f} / {section.mean:.1f} / {section.most:.0f} cycles")
    count = net["frame"].count
    sensing = (net["sense_isr"].mean + ISR_EDGES_CYCLES) * net["sense_isr"].count / count
    print(f"{VECTORS} vectors at {settings.rate_limit_hz} Hz, {period} cycles: work {net['frame'].mean:.0f}, "
          f"at most {sections['5'].most:.0f} with interrupts; sensing interrupts {sensing:.0f}")
    del net["serial_isr"]           # only requests and long queues have any
    judge_all(TARGET, [(name, "cycles_max", int(section.most)) for name, section in net.items()])
    # Now and then a frame's work ends after the next is complete; none is lost, and the next one catches up.
    assert {b.seq - a.seq & 0xFFFF for a, b in zip(frames, frames[1:])} == {1}
    assert after.late_frames - before.late_frames < 0.1 * len(frames)
    assert after.late_slots == before.late_slots
    assert sections["5"].mean < period


def test_inference_takes_the_same_time_for_every_input_inside_the_range(board):
    nano, device = board(models={0: random_model(VECTORS).image})
    features = random_features(200)
    features = features[(features > 31000).all(1) & (features < 40000).all(1)]
    device.infer(features[:1])
    nano.control.markers_clear()
    device.infer(features)
    infer = nano.control.markers()["6n"]
    assert infer.count >= 50 and infer.most - infer.least <= 0.03 * infer.most


def test_stack_beside_the_static_data_after_everything_was_used(board, avr_tools, firmware_elf):
    static = static_ram(avr_tools, firmware_elf)
    model = random_model(VECTORS)
    nano, device = board(models={0: model.image, 1: random_model(96, generation=0).image})
    device.infer(random_features(10))
    device.set_stream(raw=True, gaze=True, counts=True)
    device.settings(rate_hz=250), device.settings(repeats=4), device.settings(rate_hz=0, repeats=1)
    device.verify(1), device.verify(0), device.read_model(1)
    device.recentre((1, 1)), device.exposure(us=[100] * 6), device.exposure(auto=True), device.sync_clock()
    device.model_info(), device.probe(0), device.curve(), device.settings(power="low")
    device.link.sleep(0.5)
    free = device.status().stack_free
    used = RAM_BYTES - static - free
    print(f"static {static} B, stack used {used} B of {RAM_BYTES - static}, never touched {free} B")
    assert free >= RAM_SPARE
    judge_all(TARGET, [("firmware", "stack", used)])


def test_flash_and_ram_of_the_shipped_binary(avr_tools, firmware_elf):
    sizes = section_sizes(avr_tools, firmware_elf)
    flash = sizes[".text"] + sizes[".data"]
    ram = static_ram(avr_tools, firmware_elf)
    print(f"flash {flash} B of {PROGRAM_BYTES}, static RAM {ram} B of {RAM_BYTES}")
    assert flash <= PROGRAM_BYTES
    judge_all(TARGET, [("firmware", "flash", flash), ("firmware", "ram", ram)])


def test_nothing_of_the_binary_lies_in_the_model_slots(avr_tools, firmware_elf):
    listing = run(avr_tools / "avr-objdump", "-h", firmware_elf)
    loaded = [line.split() for line in listing.splitlines() if line.split()[1:2] in ([".text"], [".data"])]
    assert len(loaded) == 2
    assert all(int(row[4], 16) + int(row[2], 16) <= PROGRAM_BYTES for row in loaded)


def run(*command):
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def section_sizes(avr_tools, elf):
    listing = run(avr_tools / "avr-size", "-A", "-d", elf)
    rows = [line.split() for line in listing.splitlines()]
    return {row[0]: int(row[1]) for row in rows if len(row) == 3 and row[1].isdigit()}


def static_ram(avr_tools, elf):
    sizes = section_sizes(avr_tools, elf)
    return sum(sizes.get(name, 0) for name in (".data", ".bss", ".noinit"))

