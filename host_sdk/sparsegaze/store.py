# SPDX-License-Identifier: Apache-2.0
"""Putting a model into the device: the inactive of two flash slots, its header page last.

A cut at any moment leaves the old model or the new one: until its last page is whole the slot is not a model,
and the other slot is never touched.
"""

import os
from typing import NamedTuple

from .device import Device
from .errors import DeviceError, DisconnectedError, FlashError, ModelError, NoDeviceError, PortError
from .stk500 import PAGE_BYTES, Bootloader, verify_pages, write_pages
from .transport import open_link
from .wire import ERROR_TEXT, ffi, lib

_AGAIN = "fit the recording again (`sparsegaze fit`) or copy the file again"
_OLD_STAYS = "the old model is still in place; upload again"


class UploadReport(NamedTuple):
    slot: int                   # enum sg_slot
    generation: int
    crc: int                    # CRC-32 of the model, the same on host and device
    bytes: int
    vectors: int
    seconds: float              # on the link's clock


def upload(port, model, progress=None):
    """Store `model` in the device behind `port` and make it the active one.

    port      a port's name or an open Link
    model     image bytes, or an object with .image (DeviceModel)
    progress  called as progress(stage, done, total), stage "write", "verify" or "press reset"
    Returns an UploadReport once the restarted device says that this model, by its CRC, is the one in use.
    Raises ModelError (before the device is touched), FlashError, PortError, NoDeviceError, DisconnectedError.
    """
    image = bytes(getattr(model, "image", model))
    head = check_image(image)
    if isinstance(port, (str, os.PathLike)):
        with open_link(os.fspath(port)) as link:
            return _upload(link, image[:head.length], progress)
    return _upload(port, image[:head.length], progress)


def check_image(image):
    """The header (struct sg_model_head) of a whole, undamaged model image; all else raises ModelError."""
    head = ffi.new("struct sg_model_head *")
    ffi.memmove(head, image, min(len(image), lib.SG_MODEL_PAGE))
    if len(image) < lib.SG_MODEL_HEAD_BYTES:
        raise ModelError(f"the model is truncated: {len(image)} bytes, "
                         f"a header alone has {lib.SG_MODEL_HEAD_BYTES}", _AGAIN)
    if head.magic != lib.SG_MODEL_MAGIC:
        raise ModelError("this is not a sparsegaze model (wrong magic number)",
                         "give a .sgm file made by `sparsegaze fit`")
    if head.version != lib.SG_MODEL_VERSION:
        raise ModelError(f"the model has format version {head.version}, "
                         f"this SDK knows {lib.SG_MODEL_VERSION}",
                         "fit the recording again with this SDK")
    if head.length > len(image):
        raise ModelError(f"the model is truncated: {len(image)} of {head.length} bytes", _AGAIN)
    if not 1 <= head.channels <= lib.SG_MODEL_CHANNELS:
        raise ModelError(f"the model takes {head.channels} channels, "
                         f"a device has at most {lib.SG_MODEL_CHANNELS}",
                         "fit a recording of this device")
    code = _open(image)
    if code != lib.SG_OK:
        raise ModelError(f"the model is damaged: {ERROR_TEXT.get(code, code)}", _AGAIN)
    return head


def stamp(image, generation):
    """The image with this generation and the CRC that follows from it."""
    data = bytearray(image)
    head = ffi.from_buffer("struct sg_model_head *", data)
    head.generation = generation & 0xFFFFFFFF
    start = ffi.offsetof("struct sg_model_head", "generation")
    head.crc = lib.sg_model_crc32(0, ffi.from_buffer(data)[start:len(data)], len(data) - start)
    return bytes(data)


def choose_slot(info):
    """(slot to write, generation to give) by a ModelInfo: never the slot that the device would start from."""
    valid = [slot for slot in (lib.SG_SLOT_A, lib.SG_SLOT_B) if info.verdict[slot] == lib.SG_OK]
    if not valid:
        return lib.SG_SLOT_A, 1
    newest = valid[0]
    for slot in valid[1:]:
        if (info.generation[slot] - info.generation[newest]) & 0xFFFFFFFF < 0x80000000:
            newest = slot
    return 1 - newest, (info.generation[newest] + 1) & 0xFFFFFFFF


def _upload(link, image, progress):
    start = link.now()
    device = Device(link)
    _check_fit(image, device.hello)
    slot, generation = choose_slot(device.model_info())
    image = stamp(image, generation)
    crc = ffi.from_buffer("struct sg_model_head *", image).crc
    base = device.hello.slot_base[slot]
    padded = image + b"\xff" * (-len(image) % PAGE_BYTES)
    pages = [(base + at, padded[at:at + PAGE_BYTES]) for at in range(0, len(padded), PAGE_BYTES)]
    header, rest = pages[0], pages[1:]
    bootloader = Bootloader(link)
    remedy = _OLD_STAYS
    try:
        bootloader.enter(progress)
        write_pages(bootloader, rest, _steps(progress, "write", 0, len(pages)))
        verify_pages(bootloader, rest, _steps(progress, "verify", 0, len(pages)))
        remedy = "the device holds the old model or the new one, whole; upload again"
        write_pages(bootloader, [header], _steps(progress, "write", len(rest), len(pages)))
        verify_pages(bootloader, [header], _steps(progress, "verify", len(rest), len(pages)))
        bootloader.leave()
        device.connect(boot_wait_s=0.3)
    except (DisconnectedError, FlashError, NoDeviceError, PortError) as error:
        raise type(error)(f"the upload was not finished: {error.message}", remedy) from None
    info = device.model_info()
    if info.active != slot or info.crc[slot] != crc:
        verdict = info.verdict[slot]
        raise DeviceError(verdict, "the device does not use the uploaded model "
                          f"({ERROR_TEXT.get(verdict, 'another one is newer')})",
                          "upload again; `sparsegaze info` shows both slots")
    return UploadReport(slot, generation, crc, len(image), info.vectors[slot], link.now() - start)


def _check_fit(image, hello):
    head = ffi.from_buffer("struct sg_model_head *", image)
    if head.version != hello.model_version:
        raise ModelError(f"the model has format version {head.version}, "
                         f"the device takes {hello.model_version}",
                         "run `sparsegaze flash` with the firmware of this SDK")
    if head.channels != hello.channels:     # a channel that the fit dropped keeps its place, with gain 0
        raise ModelError(f"the model takes {head.channels} channels, the device has {hello.channels}",
                         "fit a recording of this device")
    if len(image) > hello.slot_bytes:
        raise ModelError(f"the model has {len(image)} bytes, a slot of the device holds {hello.slot_bytes}",
                         "fit with fewer calibration vectors")


def _open(image):
    view = ffi.new("struct sg_model_view *")
    buffer = ffi.from_buffer(image)     # kept alive over the call: the view borrows it
    return lib.sg_model_open(view, buffer, len(image), 0)


def _steps(progress, stage, done, total):
    state = [done]

    def step():
        state[0] += 1
        if progress is not None:
            progress(stage, state[0], total)
    return step
