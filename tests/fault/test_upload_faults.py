# SPDX-License-Identifier: Apache-2.0
"""Models that must not be uploaded, uploads that are cut: the old model stays."""

import random

import pytest
from material import make_image
from fake_board import SLOT_BYTES, SLOTS, FakeBoard

from sparsegaze import device as device_module
from sparsegaze import store, wire
from sparsegaze.errors import DeviceError, DisconnectedError, ModelError
from sparsegaze.wire import ffi, lib


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    monkeypatch.setattr(device_module, "BOOT_WAIT_S", 0.0)


def changed(image, **fields):
    """The image with header fields changed and a CRC that fits them."""
    data = bytearray(image)
    head = ffi.from_buffer("struct sg_model_head *", data)
    generation = head.generation
    for name, value in fields.items():
        setattr(head, name, value)
    return store.stamp(bytes(data), generation)


def refused(image):
    with pytest.raises(ModelError) as caught:
        store.upload("/dev/does-not-exist", image)      # found bad before any port is opened
    assert "\n" not in str(caught.value) and caught.value.remedy
    return caught.value.message


def test_a_model_cut_off_anywhere_is_truncated():
    image = make_image(1, vectors=3)
    for n in range(len(image)):
        assert "truncated" in refused(image[:n])


def test_every_flipped_bit_is_found_before_the_port_is_opened():
    image = make_image(2, vectors=2)
    for at in range(len(image)):
        for bit in range(8):
            broken = bytearray(image)
            broken[at] ^= 1 << bit
            refused(bytes(broken))


def test_wrong_magic_version_dimension_and_kernel_each_say_what_is_wrong():
    image = make_image(3)
    assert "not a sparsegaze model" in refused(changed(image, magic=0x12345678))
    assert "format version 9" in refused(changed(image, version=9))
    assert "7 channels" in refused(changed(image, channels=7))
    assert "0 channels" in refused(changed(image, channels=0))
    assert "damaged" in refused(changed(image, kernel=5))
    assert "not a sparsegaze model" in refused(bytes(3072))


def test_a_model_the_connected_firmware_cannot_take_is_refused_before_a_reset():
    for hello, text in (({"model_version": 3}, "the device takes 3"), ({"channels": 4}, "the device has 4"),
                        ({"slot_bytes": 1024}, "a slot of the device holds 1024")):
        with FakeBoard(hello=hello) as board:
            with pytest.raises(ModelError, match=text):
                store.upload(board.port, make_image(4))
            assert board.writes == []


def test_uploads_alternate_between_the_slots_and_generations_grow():
    images = [make_image(seed) for seed in (5, 6, 7)]
    with FakeBoard() as board:
        reports = [store.upload(board.port, image) for image in images]
        assert [report.slot for report in reports] == [0, 1, 0]
        assert [report.generation for report in reports] == [1, 2, 3]
        assert [report.vectors for report in reports] == [70] * 3
        stored = bytes(board.flash[SLOTS[0]:SLOTS[0] + len(images[2])])
        assert stored == store.stamp(images[2], 3)
        assert ffi.from_buffer("struct sg_model_head *", stored).crc == reports[2].crc


def test_header_page_is_the_last_one_written():
    with FakeBoard() as board:
        store.upload(board.port, make_image(8))
        assert board.writes == [SLOTS[0] + 128 * i for i in range(1, 9)] + [SLOTS[0]]


@pytest.mark.parametrize("after", range(9))
def test_cable_pulled_after_any_page_leaves_the_old_model_bit_for_bit(after):
    old, new = make_image(9), make_image(10)
    with FakeBoard() as board:
        store.upload(board.port, old)
        flash = bytes(board.flash)
    board = FakeBoard(cut_after=after)
    board.flash[:] = flash
    with pytest.raises(DisconnectedError) as caught:
        store.upload(board.port, new)
    assert "not finished" in caught.value.message
    assert ("old model is still in place" in caught.value.remedy) or after == 8
    first = slice(SLOTS[0], SLOTS[0] + SLOT_BYTES)
    assert bytes(board.flash[first]) == flash[first]
    again = FakeBoard()
    with again:
        again.flash[:] = board.flash
        with device_module.Device(again.port) as device:
            info = device.model_info()
            assert info.active == 0 and info.crc[0] == ffi.from_buffer("struct sg_model_head *",
                                                                       flash[first][:128]).crc
            assert info.verdict[1] != lib.SG_OK
        assert store.upload(again.port, new).slot == 1      # and the next upload succeeds


def test_a_device_that_keeps_another_model_is_reported():
    class Stubborn(FakeBoard):
        def _model_info(self):
            info = ffi.from_buffer("struct sg_model_info *", bytearray(super()._model_info()))
            info.active = lib.SG_SLOT_NONE
            return bytes(ffi.buffer(info))

    with Stubborn() as board:
        with pytest.raises(DeviceError, match="does not use the uploaded model"):
            store.upload(board.port, make_image(11))


def test_slot_choice_never_touches_the_newest_model_and_knows_wrapped_generations():
    def info(generations, verdicts):
        fields = wire.body("struct sg_model_info", generation=generations + [0], verdict=verdicts + [-3])
        return wire.parse(wire.ModelInfo, fields)

    assert store.choose_slot(info([0, 0], [-3, -3])) == (0, 1)
    assert store.choose_slot(info([7, 99], [0, -6])) == (1, 8)
    assert store.choose_slot(info([99, 7], [-6, 0])) == (0, 8)
    assert store.choose_slot(info([7, 8], [0, 0])) == (0, 9)
    assert store.choose_slot(info([8, 7], [0, 0])) == (1, 9)
    assert store.choose_slot(info([0xFFFFFFFF, 0], [0, 0])) == (0, 1)
    assert store.choose_slot(info([0xFFFFFFFF, 5], [0, -6])) == (1, 0)
    rng = random.Random(1)
    for _ in range(100):
        generation = rng.randrange(1 << 32)
        assert store.choose_slot(info([generation, generation + 1 & 0xFFFFFFFF], [0, 0]))[0] == 0
