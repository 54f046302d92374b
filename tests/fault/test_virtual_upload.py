# SPDX-License-Identifier: Apache-2.0
"""Uploads to a virtual Nano that are cut: power at chosen cycles, the cable at chosen pages."""

import pytest
from fake_board import SLOT_BYTES, SLOTS
from material import make_image

from sparsegaze import store
from sparsegaze.device import Device
from sparsegaze.errors import DisconnectedError, FlashError, ModelError, NoDeviceError
from sparsegaze.wire import ffi, lib

MOST_VECTORS = 105             # of 12 bytes, with the smallest grid, in a slot of the Nano

CYCLES_PER_MS = 16000
# A page takes about 20 ms: its address, 133 bytes at 115200 baud, erasing, programming.
IN_A_PAGE_MS = (0.5, 5, 11.5, 12.5, 14, 16, 18, 20, 60)


def crc(image):
    return ffi.from_buffer("struct sg_model_head *", image).crc


RECORDS_READ_BACK = ("verify", 8)   # of the nine pages of a 64-vector model; then comes the header page


def cut_upload(nano, image, after, offset_ms):
    """Upload with the power failing `offset_ms` after the step `after`; the power is back at the end."""
    def progress(stage, done, total):
        if (stage, done) == after:
            nano.control.cut(nano.control.time().cycle + int(offset_ms * CYCLES_PER_MS))
    with pytest.raises((FlashError, NoDeviceError)) as caught:
        store.upload(nano.port, image, progress)
    nano.control.power(False)
    nano.control.power(True)
    assert "the upload was not finished" in caught.value.message
    return caught.value


@pytest.mark.parametrize("after", [("write", 1), ("write", 5), ("verify", 3), RECORDS_READ_BACK],
                         ids="{0[0]}-{0[1]}".format)
def test_power_cut_at_any_moment_of_an_upload_leaves_the_old_model_or_the_new_one_bit_for_bit(
        virtual_nano, firmware_hex, after):
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex)
    store.upload(nano.port, make_image(20))
    report = store.upload(nano.port, make_image(21))
    old = store.stamp(make_image(21), 2)
    seen = []
    for turn, offset_ms in enumerate(IN_A_PAGE_MS):
        error = cut_upload(nano, make_image(30 + turn), after, offset_ms)
        assert ("old model is still in place" in error.remedy) == (after != RECORDS_READ_BACK)
        new = store.stamp(make_image(30 + turn), report.generation + 1)
        with Device(nano.port) as device:
            info = device.model_info()
            found = device.read_model()
            assert found in (old, new)
            assert info.crc[info.active] == crc(found) == device.verify(info.active).crc
            seen.append(found == new)
            if found == new:
                assert after == RECORDS_READ_BACK   # only the header page makes the new one
                break
            assert info.active == report.slot and info.verdict[1 - report.slot] != lib.SG_OK
    assert any(seen) == (after == RECORDS_READ_BACK) and not all(seen)
    assert store.upload(nano.port, make_image(50)).crc != 0     # and the next upload is in order


def test_power_cut_in_the_very_first_upload_leaves_no_half_model(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex)
    for after, offset_ms in ((("write", 1), 13), (("write", 6), 2), (RECORDS_READ_BACK, 5)):
        cut_upload(nano, make_image(60), after, offset_ms)
        with Device(nano.port) as device:
            info = device.model_info()
            assert info.active == lib.SG_SLOT_NONE and info.verdict[0] != lib.SG_OK
    assert store.upload(nano.port, make_image(60)).generation == 1


@pytest.mark.parametrize("after", [("write", 3), ("verify", 4), RECORDS_READ_BACK, ("write", 9)],
                         ids="{0[0]}-{0[1]}".format)
def test_simulator_killed_during_an_upload_is_a_pulled_cable(virtual_nano, firmware_hex, tmp_path, after):
    state = tmp_path / "state"
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex, state_dir=state)
    store.upload(nano.port, make_image(70))
    old = store.stamp(make_image(70), 1)

    def pull(stage, done, total):
        if (stage, done) == after:
            nano.control.power(False)
            nano.kill()

    with pytest.raises(DisconnectedError) as caught:
        store.upload(nano.port, make_image(71), pull)
    assert "the upload was not finished" in caught.value.message
    late = after in (RECORDS_READ_BACK, ("write", 9))
    assert ("the old model is still in place" in caught.value.remedy) == (not late)
    nano.stop()
    again = virtual_nano(map=False, unpaced=True, state_dir=state)
    with Device(again.port) as device:
        expected = store.stamp(make_image(71), 2) if after == ("write", 9) else old
        assert device.read_model() == expected


def test_largest_model_fits_a_slot_and_leaves_its_neighbours_alone(virtual_nano, firmware_hex, tmp_path):
    state = tmp_path / "state"
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex, state_dir=state)
    images = [make_image(80 + i, vectors=MOST_VECTORS) for i in range(2)]
    for image in images:
        assert store.upload(nano.port, image).vectors == MOST_VECTORS
    nano.stop()
    flash = (state / "flash.bin").read_bytes()
    for slot, image in enumerate(images):
        base = SLOTS[slot]
        assert len(image) > SLOT_BYTES - 20        # another vector would not fit
        assert flash[base:base + len(image)] == store.stamp(image, slot + 1)
    assert flash[SLOTS[1] + SLOT_BYTES:0x7E00] == b"\xff" * (0x7E00 - 0x7800)


def test_damaged_model_is_refused_with_the_device_untouched(virtual_nano, firmware_hex):
    nano = virtual_nano(map=False, unpaced=True, app=firmware_hex)
    store.upload(nano.port, make_image(90))
    before = nano.control.counters()
    broken = bytearray(make_image(91))
    broken[700] ^= 1
    for image in (bytes(broken), make_image(91)[:-5], b"GZGM", b""):
        with pytest.raises(ModelError):
            store.upload(nano.port, image)
    after = nano.control.counters()
    assert (after["resets"], after["page_writes"]) == (before["resets"], before["page_writes"])
