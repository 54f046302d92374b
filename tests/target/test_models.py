# SPDX-License-Identifier: Apache-2.0
"""Models on the device: bit identity with the host's core, the store, the RAM trial, the recentre offset."""

import binascii
import struct
import zlib

import numpy as np
import pytest

from conftest import collect, exchange, random_features, random_model
from sparsegaze import replay, wire
from sparsegaze.device import Device
from sparsegaze.errors import DeviceError
from sparsegaze.model import DeviceModel
from sparsegaze.qemu import QemuBoard
from sparsegaze.wire import lib

# Of what the host's core and the device both compute; changes only with the arithmetic itself.
GOLDEN_CRC = {1: 0x0D7DA0D0, 64: 0x76A99246, 216: 0x97C657F8}


def head_at(field):
    return wire.ffi.offsetof("struct sg_model_head", field)


def flat_model():
    """A model whose range is the features of the dark, 42000 .. 52000: bright light is out of it."""
    return DeviceModel.from_parts(
        offset=[42000] * 6, gain_q12=[1600] * 6, bias=[0, 0], trend=np.zeros((2, 6), int),
        centres=np.full((1, 6), 128), weights=np.zeros((1, 2), int), weight_frac_bits=8, generation=1)


def host_gaze(model, features, recentre_deg=(0.0, 0.0), gain=None):
    """[n, 4] integers azimuth, elevation (1/128 deg), flags, sigma's code, as the host's core computes them."""
    affine = np.array(tuple(wire.affine(recentre_deg, gain)), replay.AFFINE)
    gazes = replay.infer(model, features, recentre=affine)
    return np.column_stack([*gazes]).astype(np.int32)


def device_gaze(device, features):
    found = device.infer(features)
    sigma = replay.sigma_code(found.sigma_deg)
    columns = [found.azimuth_deg * 128, found.elevation_deg * 128, found.flags, sigma]
    return np.stack(columns, 1).astype(np.int32)


def test_infer_is_bit_identical_to_the_host_core(board):
    crc = {}
    features = random_features(300)
    for vectors in (1, 64, 216):
        model = random_model(vectors, seed=vectors)
        _, device = board(models={1: model.image})
        expected, found = host_gaze(model, features), device_gaze(device, features)
        device.close()
        assert len({tuple(row) for row in expected.tolist()}) > 200     # the vectors are worth something
        np.testing.assert_array_equal(found, expected)
        crc[vectors] = zlib.crc32(found.astype("<i4").tobytes())
    print("infer crc32 " + " ".join(f"n={n}:{value:08x}" for n, value in crc.items()))
    assert crc == GOLDEN_CRC


def test_streamed_gaze_is_what_the_host_computes_from_the_raw_frame(board):
    model = random_model(64)
    nano, device = board(models={0: model.image})
    device.recentre((1.5, -2.25), [[0.125, -0.05], [0.02, -0.248]])
    device.set_stream(raw=True, gaze=True)
    frames = collect(device, 20)
    device.exposure(us=[50, 90, 130, 170, 210, 250])
    frames += collect(device, 100)
    device.exposure(auto=True)
    nano.control.set("ambient", "room")
    frames += collect(device, 300)
    assert {frame.raw.model_crc for frame in frames} == {model.crc}
    for frame in frames:
        raw, gaze = frame.raw, frame.gaze
        correction = raw.recentre.offset_deg, raw.recentre.gain
        (az, el, flags, sigma), = host_gaze(model, np.array([raw.feature]), *correction)
        flags |= raw.flags
        if raw.flags & (lib.SG_FLAG_SATURATED | lib.SG_FLAG_STARVED | lib.SG_FLAG_RECOVERING):
            flags &= ~lib.SG_FLAG_VALID
        assert (gaze.azimuth_deg_q7, gaze.elevation_deg_q7, gaze.flags) == (az, el, flags)
        assert gaze.sigma_log2_q4 == sigma
        assert gaze.t_us == raw.t_us
    assert any(frame.raw.flags & lib.SG_FLAG_EXPOSURE for frame in frames)


def test_frames_after_one_out_of_range_are_recovering_for_108_ms_and_not_valid(board):
    """The bit is in the raw frame, so that the gaze stays a function of it; requests are not concerned."""
    nano, device = board(models={0: flat_model().image})
    nano.control.motion(False)
    device.exposure(us=[200] * 6)
    device.set_stream(raw=True, gaze=True)
    calm = collect(device, 60)[30:]
    assert all(frame.gaze.valid and not frame.raw.flags & lib.SG_FLAG_RECOVERING for frame in calm)
    nano.control.set("ambient", "sun_gap")
    outside = collect(device, 40)
    nano.control.set("ambient", "dark")
    frames = outside + collect(device, 90)
    out = [bool(frame.gaze.flags & lib.SG_FLAG_OUT_OF_RANGE) for frame in frames]
    last = max(k for k, is_out in enumerate(out) if is_out)
    assert sum(out) > 20 and last < 60
    for k, frame in enumerate(frames):
        recovering = any(out[max(0, k - 8):k])
        assert bool(frame.raw.flags & lib.SG_FLAG_RECOVERING) == recovering
        assert bool(frame.gaze.flags & lib.SG_FLAG_RECOVERING) == recovering
        assert frame.gaze.valid == (not recovering and not out[k])
    assert frames[last + 8].raw.flags & lib.SG_FLAG_RECOVERING and frames[last + 9].gaze.valid
    period_us = device.hello.frame_period_us
    assert 8 * period_us == pytest.approx(31_000, rel=0.01)

    nano.control.set("ambient", "sun_gap")
    collect(device, 40)
    assert not device.infer([calm[0].raw.feature]).flags[0] & lib.SG_FLAG_RECOVERING


@pytest.mark.parametrize("a, b, active",
                         [(1, 2, 1), (2, 1, 0), (0xFFFFFFFF, 0, 1), (0, 0xFFFFFFFF, 0), (7, 7, 0)],
                         ids=["newer_in_b", "newer_in_a", "wrapped_in_b", "wrapped_in_a", "equal_keeps_a"])
def test_the_newer_generation_is_used(board, a, b, active):
    models = {0: random_model(10, seed=1, generation=a), 1: random_model(10, seed=2, generation=b)}
    _, device = board(models={slot: model.image for slot, model in models.items()})
    info = device.model_info()
    assert info.active == active and info.verdict == (0, 0, lib.SG_E_MAGIC)
    assert info.crc[:2] == (models[0].crc, models[1].crc) and info.generation[:2] == (a, b)
    assert device.read_model() == models[active].image


def test_a_damaged_slot_is_passed_over_and_named(board):
    good = random_model(12, seed=1, generation=1)
    newer = bytearray(random_model(12, seed=2, generation=9).image)
    newer[300] ^= 1
    _, device = board(models={0: good.image, 1: bytes(newer)})
    info = device.model_info()
    assert info.active == 0 and info.verdict[1] == lib.SG_E_CRC and info.crc[1] == 0
    verdict = device.verify(1)
    assert verdict.verdict == lib.SG_E_CRC and verdict.crc == zlib.crc32(bytes(newer)[8:])


def test_verify_computes_the_crc_afresh_without_a_late_frame(board):
    model = random_model(64)
    _, device = board(models={0: model.image})
    device.set_stream(raw=True, gaze=True)
    verdict = device.verify(0)
    assert (verdict.verdict, verdict.crc, verdict.slot) == (0, model.crc, 0)
    assert device.verify(1).verdict == lib.SG_E_MAGIC
    status = device.status()
    assert status.late_frames == 0 and status.late_slots == 0


def test_without_a_model_gaze_is_never_valid(board):
    _, device = board()
    device.set_stream(raw=True, gaze=True)
    for frame in collect(device, 20):
        assert frame.raw.model_crc == 0
        assert frame.gaze.flags & lib.SG_FLAG_NO_MODEL and not frame.gaze.valid
    assert set(device.infer(random_features(3)).flags) == {lib.SG_FLAG_NO_MODEL}


def test_a_trial_model_is_used_from_ram_until_left_or_reset(board):
    stored, trial = random_model(64, seed=1), random_model(48, seed=2)
    features = random_features(50)
    _, device = board(models={0: stored.image})
    verdict = device.trial(trial.image)
    assert (verdict.crc, verdict.slot) == (trial.crc, lib.SG_SLOT_RAM)
    expected = host_gaze(trial, features)
    expected[:, 2] |= lib.SG_FLAG_TRIAL
    np.testing.assert_array_equal(device_gaze(device, features), expected)
    assert device.status().active == lib.SG_SLOT_RAM and device.read_model(lib.SG_SLOT_RAM) == trial.image
    device.set_stream(raw=True, gaze=True)
    frame = collect(device, 1)[0]
    assert frame.raw.flags & lib.SG_FLAG_TRIAL and frame.raw.model_crc == trial.crc
    device.set_stream()

    back = device.trial(None)
    assert (back.crc, back.slot) == (stored.crc, 0)
    np.testing.assert_array_equal(device_gaze(device, features), host_gaze(stored, features))
    device.trial(trial.image)
    device.reboot()
    assert device.status().active == 0


def test_writing_a_trial_leaves_the_one_in_use_before_it_changes(board):
    stored, trial = random_model(20, seed=1), random_model(20, seed=2)
    _, device = board(models={1: stored.image})
    device.trial(trial.image)
    exchange(device, wire.encode(lib.SG_MSG_TRIAL_WRITE, 1, b"\x10\0\2\1\xff"))
    info = device.model_info()
    assert info.active == 1 and info.verdict[lib.SG_SLOT_RAM] == lib.SG_E_STATE


@pytest.mark.parametrize("at, error",
                         [(300, lib.SG_E_CRC), (0, lib.SG_E_MAGIC), (head_at("version"), lib.SG_E_VERSION),
                          (head_at("vectors"), lib.SG_E_BOUNDS)],
                         ids=["record_flipped", "magic", "version", "vectors"])
def test_a_bad_trial_is_refused_and_the_stored_model_stays_in_use(board, at, error):
    stored, damaged = random_model(20, seed=1), bytearray(random_model(20, seed=2).image)
    damaged[at] ^= 0x40
    _, device = board(models={0: stored.image})
    with pytest.raises(DeviceError) as caught:
        device.trial(bytes(damaged))
    assert caught.value.code == error
    info = device.model_info()
    assert info.active == 0 and info.verdict[lib.SG_SLOT_RAM] == error


def test_recentre_belongs_to_its_model_and_survives_a_restart(board):
    stored, trial = random_model(64, seed=1), random_model(30, seed=2)
    features = random_features(20)
    nano, device = board(models={0: stored.image})
    gain = [[0.1, -0.03], [0.04, -0.2]]
    device.recentre((2.5, -1.0), gain)
    moved = host_gaze(stored, features, (2.5, -1.0), gain)
    assert (moved != host_gaze(stored, features, (2.5, -1.0))).any()
    np.testing.assert_array_equal(device_gaze(device, features), moved)

    device.trial(trial.image)
    assert device.recentre().affine == wire.affine((0, 0))      # another model, another correction
    device.trial(None)
    assert device.recentre().affine == wire.affine((2.5, -1.0), gain)

    device.link.sleep(0.5)                          # EEPROM takes 3.4 ms a byte
    nano.control.power(False)
    nano.control.power(True)
    device.connect()
    np.testing.assert_array_equal(device_gaze(device, features), moved)
    device.recentre(clear=True)
    device.reboot()                                 # waits for the EEPROM by itself
    np.testing.assert_array_equal(device_gaze(device, features), host_gaze(stored, features))


@pytest.mark.parametrize("offset, gain", [
    ((255, -255), None), ((255, 255), [[0.248, 0.248], [0.248, 0.248]]),
    ((-255, 0), [[-0.248, 0.248], [0.248, -0.248]]), ((0, 0), [[1 / 512, 0], [0, -1 / 512]])])
def test_any_correction_is_bit_identical_and_saturates_instead_of_wrapping(board, offset, gain):
    model, features = random_model(64), random_features(100)
    _, device = board(models={0: model.image})
    with QemuBoard(model.image) as cortex_m4, Device(cortex_m4) as other:
        for each in (device, other):
            assert each.recentre(offset, gain).affine == wire.affine(offset, gain)
            np.testing.assert_array_equal(device_gaze(each, features), host_gaze(model, features, offset, gain))


def test_every_gain_of_the_wire_is_legal_also_the_most_negative(board):
    model = random_model(64)
    _, device = board(models={0: model.image})
    odd = wire.Affine((-1, 1), (-128, 127, -128, -128))
    body = wire.body("struct sg_recentre", op=lib.SG_RECENTRE_SET, affine=odd._asdict())
    (answer,) = exchange(device, wire.encode(lib.SG_MSG_RECENTRE, 3, body))
    assert wire.parse(wire.Recentre, answer.body).affine == odd
    features = random_features(100)
    gazes = replay.infer(model, features, recentre=np.array(tuple(odd), replay.AFFINE))
    np.testing.assert_array_equal(device_gaze(device, features)[:, :2], gazes.q7)


def live_record(version, model_crc, affine, boots):
    """A copy of the live state in EEPROM as firmware of wire version 1 or 2 has it, sequence number 5."""
    gain = bytes(value & 255 for value in affine.gain_q9) if version == 2 else b""
    payload = (struct.pack("<Ihh", model_crc, *affine.offset_deg_q7) + gain
               + struct.pack("<6HHBB", *[2000] * 6, boots, 0, version) + struct.pack("<H", 5))
    return payload + binascii.crc_hqx(payload, 0xFFFF).to_bytes(2, "little")


def test_the_live_state_of_the_firmware_before_is_read_and_left_where_it_was(board, tmp_path):
    model, affine = random_model(20), wire.affine((1.5, -2.5), [[0.1, 0], [0, 0]])
    state = tmp_path / "state"
    state.mkdir()
    old = live_record(1, model.crc, affine, 41)
    assert len(old) == 28
    for place in (0, 28):                           # either copy
        (state / "eeprom.bin").write_bytes((bytes(place) + old).ljust(1024, b"\xff"))
        nano, device = board(models={0: model.image}, state_dir=state)
        assert device.recentre().affine == affine._replace(gain_q9=(0, 0, 0, 0))
        assert device.status().boot_count == 42 and not device.exposure().automatic
        device.link.sleep(0.5)
        device.reboot()                             # now from its own record
        assert device.status().boot_count == 43 and device.recentre().azimuth_deg == 1.5
        device.close()
        nano.stop()
        assert (state / "eeprom.bin").read_bytes()[place:place + 28] == old


def test_a_live_state_of_an_unknown_version_is_begun_afresh(board, tmp_path):
    model = random_model(20)
    state = tmp_path / "state"
    state.mkdir()
    unknown = bytearray(live_record(2, model.crc, wire.affine((1, 1)), 41))
    unknown[27] = 77
    unknown[30:32] = binascii.crc_hqx(bytes(unknown[:30]), 0xFFFF).to_bytes(2, "little")
    (state / "eeprom.bin").write_bytes((b"\xff" * 56 + unknown).ljust(1024, b"\xff"))
    _, device = board(models={0: model.image}, state_dir=state)
    assert device.recentre().affine == wire.affine((0, 0)) and device.status().boot_count == 1


def test_a_correction_set_while_the_one_before_is_written_is_the_one_kept(board):
    model, gain = random_model(20), [[0.1, -0.03], [0.04, -0.2]]
    nano, device = board(models={0: model.image})
    device.link.sleep(0.5)
    device.recentre((1.25, 2.5), gain)
    for k in range(5):
        device.link.sleep(0.011 * k)
        device.recentre((k, -k), gain)
    device.link.sleep(0.5)
    nano.control.power(False)
    nano.control.power(True)
    device.connect()
    assert device.recentre().affine == wire.affine((4, -4), gain)


def test_model_images_are_exactly_what_was_stored(board):
    model = random_model(216)
    _, device = board(models={0: model.image})
    assert DeviceModel(device.read_model(0)).image == model.image


@pytest.mark.parametrize("after_ms", [0.5, 3, 9, 21, 40, 55, 70, 85, 100, 130])
def test_power_cut_while_the_offset_is_written_leaves_the_old_or_the_new(board, after_ms):
    model = random_model(20)
    nano, device = board(models={0: model.image})
    device.link.sleep(0.5)
    old, new = ((1.25, 2.5), [[0.1, -0.03], [0.04, -0.2]]), ((-3.0, 4.75), [[-0.2, 0.01], [-0.06, 0.15]])
    device.recentre(*old)
    device.link.sleep(0.5)
    device.recentre(*new)
    nano.control.cut(nano.control.time().cycle + int(after_ms * 16000))
    device.link.sleep(after_ms * 1e-3 - 0.0001)
    nano.control.command("time")
    nano.control.power(False)
    nano.control.power(True)
    device.connect()
    assert device.recentre().affine in (wire.affine(*old), wire.affine(*new))
    assert device.status().boot_count == 2
