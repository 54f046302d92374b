# SPDX-License-Identifier: Apache-2.0
"""What the shipped firmware takes of the chip, and how much light its headset puts on the eye."""

import struct
from pathlib import Path

from sparsegaze.errors import SparsegazeError

ROOT = Path(__file__).resolve().parents[2]
ELF = ROOT / "build" / "firmware" / "firmware.elf"
HEADSET = ROOT / "headsets" / "led2gaze.toml"
FLASH_BYTES, RAM_BYTES = 32768, 2048
SLOTS_BYTES, BOOTLOADER_BYTES = 2 * 1536, 512  # two models, Optiboot: taken as well
OLD_BOOTLOADER_BYTES = 2048  # of boards that speak 57600 baud
SPARE = 0.10


def size(elf=ELF):
    """{"flash", "ram"} of an ELF: bytes of program and initialised data, and of static data."""
    text = data = bss = 0
    try:
        image = Path(elf).read_bytes()
    except OSError as error:
        raise SparsegazeError(f"cannot read {elf}: {error.strerror}", "run `make firmware`") from None
    for name, kind, flags, length in sections(image):
        if flags & 2 and name not in (".eeprom", ".fuse", ".lock", ".signature"):
            text += length if kind != 8 and not flags & 1 else 0
            data += length if kind != 8 and flags & 1 else 0
            bss += length if kind == 8 else 0
    taken = text + data + SLOTS_BYTES + BOOTLOADER_BYTES
    return {
        "flash": {
            "bytes": text + data,
            "taken": taken,
            "room": FLASH_BYTES,
            "spare": 1 - taken / FLASH_BYTES,
            "spare_old_loader": 1 - (taken - BOOTLOADER_BYTES + OLD_BOOTLOADER_BYTES) / FLASH_BYTES,
        },
        "ram": {"bytes": data + bss, "room": RAM_BYTES},
    }


def sections(image):
    """[(name, type, flags, bytes)] of a 32-bit little-endian ELF."""
    if image[:6] != b"\x7fELF\x01\x01":
        raise SparsegazeError("the firmware is no 32-bit ELF", "run `make firmware`")
    (table,) = struct.unpack_from("<I", image, 32)
    width, count, names = struct.unpack_from("<HHH", image, 46)
    heads = [struct.unpack_from("<10I", image, table + k * width) for k in range(count)]
    base = heads[names][4]

    def name(offset):
        return image[base + offset : image.index(b"\0", base + offset)].decode("ascii", "replace")

    return [(name(head[0]), head[1], head[2], head[5]) for head in heads]


def words(found):
    """What `size` found of the flash, in one line."""
    flash = found["flash"]
    return (
        f"flash: {flash['bytes']:,} of {flash['room']:,} B; with two model slots "
        f"{100 * flash['spare']:.1f} % to spare beside Optiboot ({BOOTLOADER_BYTES} B), "
        f"{100 * flash['spare_old_loader']:.1f} % beside the older bootloader ({OLD_BOOTLOADER_BYTES} B)"
    )


def safety():
    """{"irradiance_w_m2", "margin", "safety"}: sparsegaze.eyesafety's report of the default headset."""
    from sparsegaze.eyesafety import examine
    from sparsegaze.headset import load_headset

    report = examine(load_headset(HEADSET)).report()
    return {"irradiance_w_m2": report["irradiance_w_m2"], "margin": report["margin"], "safety": report}


if __name__ == "__main__":
    print(words(size()))
