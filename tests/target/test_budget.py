# SPDX-License-Identifier: Apache-2.0
"""Cycles, stack, flash and RAM of the shipped binary against tests/budget.csv."""

import subprocess

import numpy as np
import pytest

from budget import judge_all
from conftest import collect, costly_model, random_features, random_model

from sparsegaze.model import FLAG_OUT_OF_RANGE, kernel_q16, quantise

TARGET = "atmega328p"
FRAME_CYCLES = 61_440
RAM_BYTES = 2048
STACK_LEAST_FREE = 100
# What an interrupt costs outside of its markers, at most: entry, jump, 13 registers and flags saved, return.
ISR_EDGES_CYCLES = 90
SECTIONS = {"infer": "0", "feature": "1", "output": "2", "sense_isr": "3", "serial_isr": "4", "frame": "5"}


@pytest.fixture
def costly(board, tmp_path):
    """A streaming board whose every frame evaluates 64 kernels, 6 guards and a correction: (VirtualNano, Device, model)."""
    nano, device = board(models={}, state_dir=tmp_path / "looking")
    device.set_stream(raw=True)
    # Frames without blinks: the median over some seconds of a person who looks straight ahead.
    middle = np.median([frame.raw.feature for frame in collect(device, 600)], axis=0)
    device.close()
    nano.stop()
    model = costly_model(middle)
    nano, device = board(models={0: model.image})
    device.recentre((0.5, -0.5), [[0.05, -0.02], [0.01, 0.03]])
    device.set_stream(raw=True, gaze=True)
    collect(device, 20)
    nano.control.markers_clear()
    return nano, device, model


def test_cycles_of_every_section_while_the_costliest_ordinary_model_streams(costly):
    nano, device, model = costly
    frames = collect(device, 400)
    features = np.array([frame.raw.feature for frame in frames])
    whole = (kernel_q16(quantise(features, model.offset, model.gain_q12)[0], model.centres) > 0).all(axis=1)
    whole &= [not frame.gaze.flags & FLAG_OUT_OF_RANGE for frame in frames]
    assert whole.mean() > 0.9, "the model does not sit where the eye looks"
    sections = nano.control.markers()
    net = {name: sections[f"{key}n"] for name, key in SECTIONS.items()}
    for name, section in net.items():
        print(f"{name}: {section.least:.0f} / {section.mean:.1f} / {section.most:.0f} cycles")
    frames = net["frame"].count
    busy = net["frame"].mean + sum((net[name].mean + ISR_EDGES_CYCLES) * net[name].count / frames
                                   for name in ("sense_isr", "serial_isr"))
    print(f"busy {100 * busy / FRAME_CYCLES:.1f} % of a frame; "
          f"with interrupts a frame's work took at most {sections['5'].most:.0f} cycles")
    assert busy < 0.70 * FRAME_CYCLES and sections["5"].most < 0.70 * FRAME_CYCLES
    assert device.status().late_frames == 0
    judge_all(TARGET, [(name, "cycles_max", int(section.most)) for name, section in net.items()])


def test_inference_takes_the_same_time_for_every_input_inside_the_range(board):
    nano, device = board(models={0: random_model(64).image})
    features = random_features(400)
    features = features[(features > 31000).all(1) & (features < 40000).all(1)]
    device.infer(features[:1])
    nano.control.markers_clear()
    device.set_stream(gaze=True)
    collect(device, 100)
    infer = nano.control.markers()["0n"]
    assert infer.most - infer.least <= 0.03 * infer.most


def test_stack_beside_the_static_data_after_everything_was_used(board, avr_tools, firmware_elf):
    static = static_ram(avr_tools, firmware_elf)
    model = random_model(64)
    nano, device = board(models={0: model.image, 1: random_model(100, generation=0).image})
    device.set_stream(raw=True, gaze=True, counts=True)
    device.infer(random_features(40))
    device.trial(random_model(48, seed=3).image)
    device.infer(random_features(10))
    device.verify(1), device.verify(0), device.read_model(1), device.trial(None)
    device.recentre((1, 1)), device.exposure(us=[100] * 6), device.exposure(auto=True), device.sync_clock()
    device.model_info()
    collect(device, 300)
    free = device.status().stack_free
    used = RAM_BYTES - static - free
    print(f"static {static} B, stack used {used} B of {RAM_BYTES - static}, never touched {free} B")
    assert RAM_BYTES - static >= 300 and free >= STACK_LEAST_FREE
    judge_all(TARGET, [("firmware", "stack", used)])


def test_flash_and_ram_of_the_shipped_binary(avr_tools, firmware_elf):
    sizes = section_sizes(avr_tools, firmware_elf)
    flash = sizes[".text"] + sizes[".data"]
    print(f"flash {flash} B of 24576, static RAM {static_ram(avr_tools, firmware_elf)} B of {RAM_BYTES}")
    assert flash <= 0x6000
    ram = static_ram(avr_tools, firmware_elf)
    judge_all(TARGET, [("firmware", "flash", flash), ("firmware", "ram", ram)])


def test_nothing_of_the_binary_lies_in_the_model_slots(avr_tools, firmware_elf):
    listing = run(avr_tools / "avr-objdump", "-h", firmware_elf)
    loaded = [line.split() for line in listing.splitlines() if line.split()[1:2] in ([".text"], [".data"])]
    assert len(loaded) == 2
    assert all(int(row[4], 16) + int(row[2], 16) <= 0x6000 for row in loaded)


def run(*command):
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def section_sizes(avr_tools, elf):
    listing = run(avr_tools / "avr-size", "-A", "-d", elf)
    rows = [line.split() for line in listing.splitlines()]
    return {row[0]: int(row[1]) for row in rows if len(row) == 3 and row[1].isdigit()}


def static_ram(avr_tools, elf):
    sizes = section_sizes(avr_tools, elf)
    return sum(sizes.get(name, 0) for name in (".data", ".bss", ".noinit"))

