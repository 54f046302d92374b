# SPDX-License-Identifier: Apache-2.0
"""Virtual Nanos that hold the firmware under test, and models to put into them."""

import subprocess

import numpy as np
import pytest

from sparsegaze import wire
from sparsegaze.device import Device
from sparsegaze.mapfile import synthetic_map
from sparsegaze.model import CHANNELS, DeviceModel
from sparsegaze.trust import Trust

FLASH_BYTES = 32768
SLOT_BASE = (0x6C00, 0x7200)
NANO_SLOT_BYTES = 1536


def random_model(vectors, seed=0, generation=1, channels=CHANNELS):
    """A model whose every field is drawn from `seed`: no gaze behind it, but every path of the arithmetic.

    Its inputs span features 30000 .. 40000 about.
    """
    rng = np.random.default_rng(seed)
    trust = Trust(row=rng.integers(-2, 3, (3, channels)), base=np.full(3, -1000), low=np.full(3, -1024),
                  high=np.full(3, 1024), expected=rng.integers(80, 170, (3, 3, 3)),
                  sigma=rng.integers(60, 140, (3, 3)), origin_deg_q7=np.full(2, -2560), scale=np.full(2, 30),
                  limit=45000, sigma_gain=3)
    return DeviceModel.from_parts(
        offset=rng.integers(30000, 31000, channels), gain_q12=rng.integers(1500, 1700, channels),
        bias=rng.integers(-2**24, 2**24, 2), trend=rng.integers(-2**10, 2**10, (2, channels)),
        centres=rng.integers(0, 256, (vectors, channels)), weights=rng.integers(-6000, 6000, (vectors, 2)),
        weight_frac_bits=8, generation=generation, trust=trust)


def costly_model(middle, vectors=64, seed=0):
    """The ordinary model that costs most: all four guards, a grid of 9 x 9, and no kernel that is 0.

    middle    [6] features in the middle of its box; the box is 8190 feature steps wide in every channel
    Its centres lie in the middle fifth of the box, so that no kernel is zero for features within 1000 steps
    of the middle, and every guard passes there, so that all are computed.
    """
    rng = np.random.default_rng(seed)
    trust = Trust(row=rng.integers(-10, 11, (4, CHANNELS)), base=np.full(4, -1000), low=np.full(4, -2**15),
                  high=np.full(4, 2**15 - 1), expected=rng.integers(0, 256, (9, 9, 4)),
                  sigma=rng.integers(60, 140, (9, 9)), origin_deg_q7=np.full(2, -2560), scale=np.full(2, 100),
                  limit=65535, sigma_gain=3)
    return DeviceModel.from_parts(
        offset=np.asarray(middle, int) - 4095, gain_q12=np.full(CHANNELS, 2048),
        bias=rng.integers(-2**24, 2**24, 2), trend=rng.integers(-2**10, 2**10, (2, CHANNELS)),
        centres=rng.integers(102, 154, (vectors, CHANNELS)), weights=rng.integers(-3000, 3000, (vectors, 2)),
        weight_frac_bits=8, trust=trust)


def random_features(n, seed=0):
    """[n, 6] features: most inside the span of random_model, some at its edges, some anywhere."""
    rng = np.random.default_rng(seed)
    inside = rng.integers(31000, 40500, (n, CHANNELS))
    anywhere = rng.integers(0, 65536, (n, CHANNELS))
    return np.where(rng.random((n, 1)) < 0.8, inside, anywhere).astype(np.uint16)


def put_models(state_dir, images):
    """Prepare the flash in `state_dir` for a virtual Nano: {slot: image bytes}, the rest erased."""
    flash = bytearray(b"\xff" * FLASH_BYTES)
    for slot, image in images.items():
        assert len(image) <= NANO_SLOT_BYTES
        flash[SLOT_BASE[slot]:SLOT_BASE[slot] + len(image)] = image
    state_dir.mkdir(parents=True, exist_ok=True)
    (state_dir / "flash.bin").write_bytes(flash)


@pytest.fixture(scope="session")
def any_map(tmp_path_factory):
    """A response map without optics."""
    return synthetic_map(str(tmp_path_factory.mktemp("map") / "synthetic.sgmap"))


@pytest.fixture
def board(virtual_nano, firmware_elf, any_map, tmp_path):
    """Factory: board(models={slot: image}, **options) -> (VirtualNano, Device), unpaced, firmware in flash.

    nano.control.lockstep is on: nothing passes but what the test lets pass.
    """
    devices = []

    def start(models=None, **options):
        options.setdefault("app", firmware_elf)
        options.setdefault("state_dir", tmp_path / "state")
        options.setdefault("person", 1)
        if models is not None:
            put_models(options["state_dir"], models)
        nano = virtual_nano(map=any_map, unpaced=True, **options)
        device = Device(nano.port)
        devices.append(device)
        return nano, device

    yield start
    for device in devices:
        device.close()


@pytest.fixture(scope="session")
def avr_tools(repo_root):
    """The folder of the AVR compiler that builds the firmware."""
    folder = repo_root / ".pio-offline" / "packages" / "toolchain-atmelavr" / "bin"
    assert (folder / "avr-gcc").exists(), "run make firmware first"
    return folder


@pytest.fixture(scope="session")
def port_with(repo_root, avr_tools, tmp_path_factory):
    """Factory: the ATmega328P port with another application; port_with(source) -> path of the ELF."""

    def build(source, *flags):
        out = tmp_path_factory.mktemp("elf") / (source.stem + ".elf")
        firmware = repo_root / "firmware"
        subprocess.run(
            [avr_tools / "avr-gcc", "-mmcu=atmega328p", "-DF_CPU=16000000L", "-std=gnu11", "-O2",
             "-Wall", "-Wextra", "-Werror", *flags,
             *[f"-I{firmware / part}" for part in ("core", "app", "ports/avr328p")],
             source, firmware / "core" / "sg_wire.c", firmware / "core" / "sg_wire_avr.S",
             *sorted((firmware / "ports" / "avr328p").glob("*.c")), "-o", out], check=True)
        return out

    return build


def exchange(device, data, wait_s=0.05):
    """Send bytes, return the packets that come back within wait_s of virtual time."""
    device.link.write(data)
    decoder, packets, end = wire.Decoder(), [], device.link.now() + wait_s
    while device.link.now() < end:
        packets += decoder.feed(device.link.read(4096, end - device.link.now()))
    assert decoder.bad == 0
    return packets


def collect(device, n, timeout_s=2.0):
    """The next n stream frames, from the first whole one on: a stream may begin amid a frame's packets."""
    frames, parts = [], bin(device._stream_bits).count("1")
    for frame in device.frames(timeout_s):
        if not frames and parts > sum(part is not None for part in (frame.raw, frame.gaze, frame.counts)):
            continue
        frames.append(frame)
        if len(frames) == n:
            return frames
    raise AssertionError(f"the stream ended after {len(frames)} of {n} frames")
