# SPDX-License-Identifier: Apache-2.0
"""model.py: the image byte by byte, hostile files, and the numpy arithmetic against the firmware's own."""

import zlib

import numpy as np
import pytest

from sparsegaze import imagefile
from sparsegaze import model as m
from sparsegaze import trust as t
from sparsegaze._core import ffi, lib
from sparsegaze.errors import ModelError
from sparsegaze.model import DeviceModel, emulate, emulate_point
from sparsegaze.trust import Trust, sigma_deg


def trust(rng, d=6, guards=3, nodes=(4, 7)):
    return Trust(
        rng.integers(-10, 11, (guards, d)),
        rng.integers(-2000, 2000, guards),
        rng.integers(-4000, -1000, guards),
        rng.integers(1000, 4000, guards),
        rng.integers(0, 256, (*nodes, guards)),
        rng.integers(0, 256, nodes),
        rng.integers(-3000, 0, 2),
        rng.integers(1, 256, 2),
        int(rng.integers(0, 65536)),
        int(rng.integers(0, 256)),
    )


def parts(seed=0, n=64, d=6, bits=8, guards=3, gain_top=4096):
    rng = np.random.default_rng(seed)
    return dict(
        offset=rng.integers(0, 3000, d),
        gain_q12=rng.integers(1, gain_top + 1, d),
        bias=rng.integers(-(2**26), 2**26, 2),
        trend=rng.integers(-3000, 3000, (2, d)),
        centres=rng.integers(0, 256, (n, d)),
        weights=rng.integers(-32768, 32768, (n, 2)),
        weight_frac_bits=bits,
        trust=trust(rng, d, guards) if guards else None,
    )


def assert_same(model, features, recentre=(0.0, 0.0)):
    az, el, flags = model.predict(features, recentre)
    az_q7, el_q7, expected = emulate(model, features, recentre)
    np.testing.assert_array_equal(az * 128, az_q7)
    np.testing.assert_array_equal(el * 128, el_q7)
    np.testing.assert_array_equal(flags, expected)
    judged, (q7, outside, doubt, code) = model.judge(features), emulate_point(model, features)
    np.testing.assert_array_equal(judged.gaze_deg * 128, np.clip(q7, -32768, 32767))
    np.testing.assert_array_equal(judged.outside, outside)
    np.testing.assert_array_equal(judged.doubt * 256, doubt)
    np.testing.assert_array_equal(judged.sigma_deg, sigma_deg(code))
    return flags


@pytest.mark.parametrize(
    "name, dtype",
    [("struct sg_model_head", m.HEAD), ("struct sg_model_guard", t.GUARD), ("struct sg_model_trust", t.PAGE)],
)
def test_layout_is_that_of_the_c_header(name, dtype):
    ctype = ffi.typeof(name)
    assert ffi.sizeof(ctype) == dtype.itemsize
    c_fields = {field: (info.offset, ffi.sizeof(info.type)) for field, info in ctype.fields}
    assert c_fields == {
        field: (dtype.fields[field][1], dtype.fields[field][0].itemsize) for field in dtype.names
    }


def test_limits_are_those_of_the_c_headers():
    for name in ("MAGIC", "VERSION", "HEAD_BYTES", "RECORD_BYTES", "CHANNELS", "SLOT_BYTES", "VECTORS_MAX"):
        assert getattr(m, name) == getattr(lib, "SG_MODEL_" + name)
    assert m.PAGE_BYTES == t.PAGE_BYTES == lib.SG_MODEL_PAGE
    assert (t.GUARDS, t.NODES_MAX, t.NODE_BYTES) == (
        lib.SG_MODEL_GUARDS, lib.SG_MODEL_NODES_MAX, lib.SG_MODEL_NODE_BYTES,
    )
    assert m.RECORD.itemsize == m.RECORD_BYTES
    for name in ("VALID", "NO_MODEL", "OUT_OF_RANGE", "SATURATED", "STARVED"):
        assert getattr(m, "FLAG_" + name) == getattr(lib, "SG_FLAG_" + name)


def test_parts_come_back_as_they_went_in():
    given = parts()
    model = DeviceModel.from_parts(**given, generation=5)
    for name in ("offset", "gain_q12", "bias", "trend", "centres", "weights"):
        np.testing.assert_array_equal(getattr(model, name), given[name])
    assert (model.generation, model.vectors, model.channels, model.weight_frac_bits) == (5, 64, 6, 8)
    for name in Trust.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(model.trust, name), getattr(given["trust"], name))
    assert (
        model.crc
        == zlib.crc32(model.image[8:])
        == lib.sg_model_crc32(0, model.image[8:], len(model.image) - 8)
    )


def test_generation_changes_nothing_else():
    model = DeviceModel.from_parts(**parts())
    other = model.with_generation(2**32 - 1)
    assert other.generation == 2**32 - 1 and other.crc != model.crc
    assert other.image[12:] == model.image[12:]
    assert other.with_generation(0).image == model.image


@pytest.mark.parametrize("seed", range(12))
def test_emulation_equals_the_core_bit_for_bit_on_random_models(seed):
    rng = np.random.default_rng(seed)
    d, n = int(rng.integers(1, 7)), int(rng.integers(1, 220))
    model = DeviceModel.from_parts(**parts(seed, n, d, 5 + seed % 5, seed % 5, 65535 if seed % 2 else 4096))
    features = rng.integers(0, 65536, (1500, d)).astype(np.uint16)
    features[::2] = model.offset[:d] + rng.integers(0, 4095 * 4096 // model.gain_q12.max(), (750, d))
    flags = assert_same(model, features, rng.uniform(-100, 100, 2))
    assert model.weight_frac_bits < 8 or model.trust.guards or set(flags[::2]) == {m.FLAG_VALID}
    assert m.FLAG_OUT_OF_RANGE in flags[1::2]


def test_emulation_equals_the_core_on_every_corner_and_centre():
    given = parts(3, n=216, guards=0)
    given["offset"], given["gain_q12"] = np.zeros(6, int), np.full(6, 4096)
    given["centres"][:64] = 255 * (np.arange(64)[:, None] >> np.arange(6) & 1)
    model = DeviceModel.from_parts(**given)
    for low, high in ((0, 4095), (0, 65535), (15, 4080), (1, 4094), (0, 4096)):
        corner = np.where(np.arange(64)[:, None] >> np.arange(6) & 1, high, low).astype(np.uint16)
        assert_same(model, corner)
    assert_same(model, (16 * given["centres"]).astype(np.uint16))


def test_emulation_equals_the_core_over_the_whole_kernel():
    # One channel, one vector at 0: T runs through every table entry; six channels: to the end of the kernel.
    model = DeviceModel.from_parts([0], [4096], [0, 0], [[0], [0]], [[0]], [[32767, -32768]], 5)
    assert_same(model, np.arange(65536, dtype=np.uint16)[:, None])
    far = DeviceModel.from_parts(
        [0] * 6, [4096] * 6, [0, 0], np.zeros((2, 6), int), [[0] * 6], [[32767, -32768]], 5
    )
    steps = np.linspace(0, 4095, 4000).astype(np.uint16)
    assert_same(far, np.repeat(steps[:, None], 6, axis=1))


def test_kernel_is_the_exponential_within_its_bound():
    rng = np.random.default_rng(1)
    s, c = rng.integers(1600, 2500, (400, 6)), rng.integers(100, 156, (50, 6))
    t = (s * s).sum(1)[:, None] / 32 + 256 * m.half_squares(c) - s @ c.T
    assert np.abs(m.kernel_q16(s, c) - 65536 * np.exp(-t / 65536)).max() <= 9


def test_saturated_output_and_recentre_are_flagged():
    model = DeviceModel.from_parts([0], [4096], [2**26, 0], [[0], [0]], [[0]], [[0, 0]], 5)
    assert assert_same(model, np.zeros((1, 1), np.uint16)).tolist() == [m.FLAG_OUT_OF_RANGE]
    model = DeviceModel.from_parts([0], [4096], [0, 0], [[0], [0]], [[0]], [[0, 0]], 8)
    assert assert_same(model, np.zeros((1, 1), np.uint16), (255.0, 0)).tolist() == [m.FLAG_VALID]
    model = DeviceModel.from_parts([0], [4096], [2**26, 0], [[0], [0]], [[0]], [[0, 0]], 8)
    assert assert_same(model, np.zeros((1, 1), np.uint16), (200.0, 0)).tolist() == [m.FLAG_OUT_OF_RANGE]


def test_order_of_the_vectors_is_irrelevant_to_the_bit():
    given = parts(5)
    features = np.random.default_rng(1).integers(0, 7000, (500, 6)).astype(np.uint16)
    before = DeviceModel.from_parts(**given).predict(features)
    order = np.random.default_rng(2).permutation(64)
    given["centres"], given["weights"] = given["centres"][order], given["weights"][order]
    for a, b in zip(before, DeviceModel.from_parts(**given).predict(features)):
        np.testing.assert_array_equal(a, b)


def test_save_and_load(tmp_path):
    model = DeviceModel.from_parts(**parts())
    model.save(tmp_path / "a.sgm")
    assert DeviceModel.load(tmp_path / "a.sgm").image == model.image
    assert [p.name for p in tmp_path.iterdir()] == ["a.sgm"]
    assert DeviceModel(model.image + b"\xff" * 100).image == model.image  # as read from a slot
    with pytest.raises(ModelError, match="cannot write"):
        model.save(tmp_path / "no" / "a.sgm")


def test_every_bit_flip_is_refused():
    image = DeviceModel.from_parts(**parts(n=8)).image
    for i in range(len(image)):
        for bit in (0, 3, 7):
            bad = bytearray(image)
            bad[i] ^= 1 << bit
            with pytest.raises(ModelError) as caught:
                DeviceModel(bad)
            assert caught.value.remedy


def test_every_truncation_is_refused(tmp_path):
    image = DeviceModel.from_parts(**parts(n=8)).image
    for length in range(len(image)):
        with pytest.raises(ModelError):
            DeviceModel(image[:length])
    (tmp_path / "cut.sgm").write_bytes(image[:300])
    with pytest.raises(ModelError, match="cut.sgm: .*cut off"):
        DeviceModel.load(tmp_path / "cut.sgm")


def _resealed(image, field, value):
    head = np.frombuffer(image, m.HEAD, 1).copy()
    head[field] = value
    return imagefile.sealed(head.tobytes() + image[m.PAGE_BYTES :])


@pytest.mark.parametrize(
    "field, value, words",
    [
        ("version", 1, "version 1"),
        ("vectors", 0, "0 vectors"),
        ("vectors", 63, "63 vectors"),
        ("length", 5, "vectors"),
        ("channels", 0, "0 channels"),
        ("channels", 7, "7 channels"),
        ("channels", 5, "does not allow"),
        ("kernel", 1, "does not allow"),
        ("weight_frac_bits", 10, "does not allow"),
        ("bias", 2**30 + 1, "does not allow"),
        ("pad", 1, "does not allow"),
    ],
)
def test_well_sealed_nonsense_is_refused_here_and_by_the_core(field, value, words):
    bad = _resealed(DeviceModel.from_parts(**parts()).image, field, value)
    with pytest.raises(ModelError, match=words):
        DeviceModel(bad)
    assert lib.sg_model_open(ffi.new("struct sg_model_view *"), bad, len(bad), 0) < 0


@pytest.mark.parametrize(
    "field, value",
    [
        ("guards", 5),
        ("guards", 2),
        ("scale", 0),
        ("nodes", 0),
        ("nodes", 1),
        ("nodes", 25),
        ("origin_deg_q7", 16385),
        ("pad", 1),
    ],
)
def test_well_sealed_nonsense_in_the_trust_page_is_refused_here_and_by_the_core(field, value):
    image = DeviceModel.from_parts(**parts()).image
    page = np.frombuffer(image, t.PAGE, 1, m.PAGE_BYTES).copy()
    page[field] = value
    bad = imagefile.sealed(image[: m.PAGE_BYTES] + page.tobytes() + image[m.HEAD_BYTES :])
    with pytest.raises(ModelError):
        DeviceModel(bad)
    assert lib.sg_model_open(ffi.new("struct sg_model_view *"), bad, len(bad), 0) < 0


@pytest.mark.parametrize("content", [b"", b"GZG", b"hello world\n" * 50, bytes(3000), b"\xff" * 3000])
def test_a_file_that_is_no_model_is_refused(tmp_path, content):
    (tmp_path / "x.sgm").write_bytes(content)
    with pytest.raises(ModelError, match="x.sgm"):
        DeviceModel.load(tmp_path / "x.sgm")


def test_missing_files_folders_and_trailing_bytes_are_refused(tmp_path):
    with pytest.raises(ModelError, match="cannot read"):
        DeviceModel.load(tmp_path / "none.sgm")
    with pytest.raises(ModelError, match="cannot read"):
        DeviceModel.load(tmp_path)
    (tmp_path / "long.sgm").write_bytes(DeviceModel.from_parts(**parts()).image + b"\0")
    with pytest.raises(ModelError, match="too many"):
        DeviceModel.load(tmp_path / "long.sgm")


def test_features_of_another_dimension_are_refused():
    model = DeviceModel.from_parts(**parts(d=4))
    with pytest.raises(ModelError, match="4 channels, the features 5"):
        model.predict(np.zeros((3, 5), np.uint16))
    assert len(model.predict(np.zeros((3, 6), np.uint16))[0]) == 3


@pytest.mark.parametrize(
    "field, value",
    [
        ("weights", 32768),
        ("weights", -32769),
        ("centres", 256),
        ("centres", -1),
        ("gain_q12", 65536),
        ("offset", -1),
        ("bias", 2**31),
        ("trend", 2**15),
    ],
)
def test_a_value_that_its_field_cannot_hold_is_refused_instead_of_wrapping(field, value):
    given = parts()
    given[field] = np.array(given[field], np.int64)
    given[field].flat[0] = value
    with pytest.raises(ModelError, match={"weights": "weight", "centres": "c reaches"}.get(field, field)):
        DeviceModel.from_parts(**given)


def test_too_many_vectors_and_guards_are_refused():
    with pytest.raises(ModelError, match="234 calibration vectors do not fit a slot of 233"):
        DeviceModel.from_parts(**parts(n=234, guards=0))
    with pytest.raises(ModelError, match="ask for 1 to 223"):
        DeviceModel.from_parts(**parts(n=224))
    with pytest.raises(ModelError, match="5 guards"):
        DeviceModel.from_parts(**parts(guards=5))
