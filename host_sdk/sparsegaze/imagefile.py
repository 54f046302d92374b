# SPDX-License-Identifier: Apache-2.0
"""Files of stored images (models, networks): read as hostile, written whole or not at all, with a CRC."""

import os
import zlib

from .errors import ModelError


def sealed(image):
    """The image with the CRC-32 (bytes 4..7) that belongs to what follows it."""
    return image[:4] + zlib.crc32(image[8:]).to_bytes(4, "little") + image[8:]


def load(kind, path, most_bytes, expected, repeat):
    """kind(image) of a file of at most most_bytes; kind checks the image and keeps it as .image.

    expected   what the file should be, in the remedy when it cannot be read
    repeat     the remedy for a long one
    Raises ModelError, naming the file.
    """
    try:
        with open(path, "rb") as file:
            image = file.read(most_bytes + 1)
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror}", f"name {expected}") from None
    try:
        made = kind(image)
    except ModelError as error:
        raise ModelError(f"{path}: {error.message}", error.remedy) from None
    over = len(image) - len(made.image)
    if over:
        raise ModelError(f"{path}: {over} bytes too many behind the image", repeat)
    return made


def save(path, image):
    """Write the file: whole, or not at all. Raises ModelError when the place cannot be written."""
    part = f"{os.fspath(path)}.{os.getpid()}.part"
    try:
        with open(part, "wb") as file:
            file.write(image)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        if os.path.exists(part):
            os.remove(part)
        raise ModelError(f"cannot write {path}: {error.strerror}", "choose another place") from None
