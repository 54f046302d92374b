# SPDX-License-Identifier: Apache-2.0
"""Models on the device: bit identity with the host's core, the store, the RAM trial, the recentre offset."""

import binascii
import contextlib
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
GOLDEN_CRC = {1: 0x40745CC1, 64: 0x768113E0, 100: 0x817841BB}


def head_at(field):
    return wire.ffi.offsetof("struct sg_model_head", field)


def flat_model(middle):
    """A model whose range is 1000 steps (a quarter octave) around six features either way."""
    return DeviceModel.from_parts(
        offset=np.asarray(middle, int) - 1000, gain_q12=[4095 * 4096 // 2000] * 6, bias=[0, 0],
        trend=np.zeros((2, 6), int), centres=np.full((1, 6), 128), weights=np.zeros((1, 2), int),
        weight_frac_bits=8, generation=1)


def host_gaze(model, features, recentre_deg=(0.0, 0.0), gain=None):
    """[n, 4] integers azimuth, elevation (1/128 deg), flags, sigma's code, as the host's core has them."""
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
    for vectors in (1, 64, 100):
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
    device.exposure(us=[50, 60, 70, 80, 90, 100])
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
        if raw.flags & (lib.SG_FLAG_SATURATED | lib.SG_FLAG_STARVED | lib.SG_FLAG_EXPOSURE | lib.SG_FLAG_FAULT
                        | lib.SG_FLAG_RECOVERING):
            flags &= ~lib.SG_FLAG_VALID
        assert (gaze.azimuth_deg_q7, gaze.elevation_deg_q7, gaze.flags) == (az, el, flags)
        assert gaze.sigma_log2_q4 == sigma
        assert gaze.t_us == raw.t_us
    assert any(frame.raw.flags & lib.SG_FLAG_EXPOSURE for frame in frames)


@pytest.mark.parametrize("rate_hz", [0, 260])
def test_frames_within_45_ms_after_one_out_of_range_are_recovering_and_not_valid(board, rate_hz):
    """The bit is in the raw frame, so that the gaze stays a function of it; requests are not concerned."""
    nano, device = board()
    nano.control.motion(False)
    device.set_stream(raw=True, gaze=True)
    middle = np.median([frame.raw.feature for frame in collect(device, 600)[-100:]], axis=0)
    device.close()
    nano.stop()
    nano, device = board(models={0: flat_model(middle).image})
    nano.control.motion(False)
    device.settings(rate_hz=rate_hz)
    device.link.sleep(0.5)
    device.set_stream(raw=True, gaze=True)
    calm = collect(device, 60)[30:]
    assert all(frame.gaze.valid and not frame.raw.flags & lib.SG_FLAG_RECOVERING for frame in calm)
    nano.control.set("lid", 0.2)
    outside = collect(device, 60)
    nano.control.set("lid", 1)
    frames = outside + collect(device, 120)
    out = [bool(frame.gaze.flags & lib.SG_FLAG_OUT_OF_RANGE) for frame in frames]
    last = max(k for k, is_out in enumerate(out) if is_out)
    assert sum(out) > 20 and last < 100
    moving = lib.SG_FLAG_SATURATED | lib.SG_FLAG_STARVED | lib.SG_FLAG_EXPOSURE
    steps = [frame.t_us >> 8 for frame in frames]       # 256 us: what the device counts in
    # What a frame out of range in settled light holds back: two frames, and 45 ms once that has lasted 11.
    holds, since = [], None
    for frame, before, step, was_out in zip(frames, [steps[0] - 99, *steps], steps, out):
        since = None if not was_out or frame.raw.flags & moving else before if since is None else since
        holds.append(0 if since is None else 176 if step - since >= 43 else 9)
    for k, frame in enumerate(frames):
        recovering = any(steps[k] - before < hold for hold, before in zip(holds[:k], steps[:k]))
        assert bool(frame.raw.flags & lib.SG_FLAG_RECOVERING) == recovering
        assert bool(frame.gaze.flags & lib.SG_FLAG_RECOVERING) == recovering
        refused = recovering or out[k] or frame.raw.flags & (moving | lib.SG_FLAG_FAULT)
        assert frame.gaze.valid == (not refused)
    assert frames[-1].gaze.valid
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


def test_verify_computes_the_crc_afresh_at_the_cost_of_one_frame(board):
    model = random_model(20)
    _, device = board(models={0: model.image})
    device.set_stream(gaze=True)
    device.link.sleep(1.0)
    first = collect(device, 300)[-1]
    dropped = device.status().tx_dropped
    verdict = device.verify(0)
    assert (verdict.verdict, verdict.crc, verdict.slot) == (0, model.crc, 0)
    assert device.verify(1).verdict == lib.SG_E_MAGIC
    assert device.status().tx_dropped - dropped <= 2 and device.status().late_slots == 0
    frames = [frame for frame in collect(device, 600) if frame.seq > first.seq]
    # Each ends in the place of an inference; nothing else is lost.
    assert frames[-1].seq - frames[0].seq + 1 - len(frames) <= 2


def test_without_a_model_gaze_is_never_valid(board):
    _, device = board()
    device.set_stream(raw=True, gaze=True)
    for frame in collect(device, 20):
        assert frame.raw.model_crc == 0
        assert frame.gaze.flags & lib.SG_FLAG_NO_MODEL and not frame.gaze.valid
    assert set(device.infer(random_features(3)).flags) == {lib.SG_FLAG_NO_MODEL}


@pytest.fixture
def with_trial():
    """Factory: with_trial(model) -> Device of a Cortex-M4 that holds the model and has room for a trial."""
    with contextlib.ExitStack() as stack:
        yield lambda model: stack.enter_context(Device(stack.enter_context(QemuBoard(model.image))))


def test_a_trial_model_is_used_from_ram_until_it_is_left(with_trial):
    stored, trial = random_model(64, seed=1), random_model(48, seed=2)
    features = random_features(50)
    device = with_trial(stored)
    verdict = device.trial(trial.image)
    assert (verdict.crc, verdict.slot) == (trial.crc, lib.SG_SLOT_RAM)
    np.testing.assert_array_equal(device_gaze(device, features), host_gaze(trial, features))
    assert device.status().active == lib.SG_SLOT_RAM and device.read_model(lib.SG_SLOT_RAM) == trial.image
    back = device.trial(None)
    assert (back.crc, back.slot) == (stored.crc, 0)
    np.testing.assert_array_equal(device_gaze(device, features), host_gaze(stored, features))


def test_the_nano_has_no_room_for_a_trial_and_says_so(board):
    _, device = board(models={0: random_model(20).image})
    assert device.hello.trial_bytes == 0
    for body in (b"\0\0\2\1x", b"\0\2\2\1x"):
        packets = exchange(device, wire.encode(lib.SG_MSG_TRIAL_WRITE, 1, body))
        assert [wire.parse_error(p.body) for p in packets] == [(lib.SG_E_BOUNDS, lib.SG_MSG_TRIAL_WRITE)]
    packets = exchange(device, wire.encode(lib.SG_MSG_TRIAL_USE, 1, b"\1"))
    assert [wire.parse_error(p.body) for p in packets] == [(lib.SG_E_BOUNDS, lib.SG_MSG_TRIAL_USE)]
    assert device.model_info().active == 0 and device.model_info().verdict[lib.SG_SLOT_RAM] == lib.SG_E_MAGIC


def test_writing_a_trial_leaves_the_one_in_use_before_it_changes(with_trial):
    stored, trial = random_model(20, seed=1), random_model(20, seed=2)
    device = with_trial(stored)
    device.trial(trial.image)
    exchange(device, wire.encode(lib.SG_MSG_TRIAL_WRITE, 1, b"\x10\0\2\1\xff"))
    info = device.model_info()
    assert info.active == 0 and info.verdict[lib.SG_SLOT_RAM] == lib.SG_E_STATE


@pytest.mark.parametrize("at, error",
                         [(300, lib.SG_E_CRC), (0, lib.SG_E_MAGIC), (head_at("version"), lib.SG_E_VERSION),
                          (head_at("vectors"), lib.SG_E_BOUNDS)],
                         ids=["record_flipped", "magic", "version", "vectors"])
def test_a_bad_trial_is_refused_and_the_stored_model_stays_in_use(with_trial, at, error):
    stored, damaged = random_model(20, seed=1), bytearray(random_model(20, seed=2).image)
    damaged[at] ^= 0x40
    device = with_trial(stored)
    with pytest.raises(DeviceError) as caught:
        device.trial(bytes(damaged))
    assert caught.value.code == error
    info = device.model_info()
    assert info.active == 0 and info.verdict[lib.SG_SLOT_RAM] == error


def test_recentre_belongs_to_its_model(with_trial):
    stored, trial = random_model(64, seed=1), random_model(30, seed=2)
    gain = [[0.1, -0.03], [0.04, -0.2]]
    device = with_trial(stored)
    device.recentre((2.5, -1.0), gain)
    device.trial(trial.image)
    assert device.recentre().affine == wire.affine((0, 0))      # another model, another correction
    device.trial(None)
    assert device.recentre().affine == wire.affine((2.5, -1.0), gain)


def test_recentre_survives_a_restart(board):
    stored, features = random_model(64, seed=1), random_features(20)
    nano, device = board(models={0: stored.image})
    gain = [[0.1, -0.03], [0.04, -0.2]]
    device.recentre((2.5, -1.0), gain)
    moved = host_gaze(stored, features, (2.5, -1.0), gain)
    assert (moved != host_gaze(stored, features, (2.5, -1.0))).any()
    np.testing.assert_array_equal(device_gaze(device, features), moved)
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
            expected = host_gaze(model, features, offset, gain)
            np.testing.assert_array_equal(device_gaze(each, features), expected)


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


def eeprom_record(size, version_at, version, sequence=5):
    """A whole copy of a live state of `size` bytes as a firmware of that record version writes it."""
    payload = bytearray(range(1, size + 1))
    payload[version_at] = version
    payload += struct.pack("<H", sequence)
    return bytes(payload) + binascii.crc_hqx(bytes(payload), 0xFFFF).to_bytes(2, "little")


@pytest.mark.parametrize("size, place, version", [(24, 0, 1), (28, 56, 2), (52, 120, 77)])
def test_a_live_state_of_another_version_is_not_read_and_a_fresh_one_begun(
        board, tmp_path, size, place, version):
    state = tmp_path / "state"
    state.mkdir()
    other = eeprom_record(size, 27 if size > 24 else 23, version)
    (state / "eeprom.bin").write_bytes((b"\xff" * place + other).ljust(1024, b"\xff"))
    _, device = board(models={0: random_model(20).image}, state_dir=state)
    assert device.recentre().affine == wire.affine((0, 0)) and device.status().boot_count == 1
    assert device.exposure().automatic and device.settings().rate_limit_hz == 1001
    device.link.sleep(0.5)
    if size != 52:
        assert (state / "eeprom.bin").read_bytes()[place:place + size + 4] == other


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
    model = random_model(100)
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
