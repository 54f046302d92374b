# SPDX-License-Identifier: Apache-2.0
"""sg_mlp on the host: against its arithmetic in numpy integers, at its extremes, and on damaged images."""
import itertools
import re
import zlib

import numpy as np
import pytest

from core_avr_harness import CORE
from mlp_models import golden_case, inputs_near, random_model
from sparsegaze import mlp
from sparsegaze._core import ffi, lib
from sparsegaze.errors import ModelError
from sparsegaze.mlp import HALF, Z_END, Layer, MlpModel, emulate

GOLDEN_CRC = 0xd3a45f29


def same_everywhere(model, features):
    """C against numpy, outputs and flags, every bit; returns the outputs in 1/128."""
    *outputs, flags = model.predict(features)
    expected, expected_flags = emulate(model, features)
    got = np.array(outputs).T * 128
    assert np.array_equal(got, expected) and np.array_equal(flags, expected_flags)
    return expected


def opened(image, room=None):
    """sg_mlp_open of bytes: (verdict, view)."""
    view, buffer = ffi.new("struct sg_mlp_view *"), ffi.from_buffer("uint8_t[]", image)
    verdict = lib.sg_mlp_open(view, buffer, len(image) if room is None else room, 0)
    return verdict, (view, buffer)


def resealed(image):
    """The image with the CRC that belongs to it."""
    return bytes(image[:4]) + zlib.crc32(bytes(image[8:])).to_bytes(4, "little") + bytes(image[8:])


def limit_layer(rows, columns, weight_bytes, sign, scale):
    """All weights at a limit (sign -1: the least, +1: the greatest), as many as 24 bits hold; bias as extreme
    as sg_mlp_open allows, on the same side."""
    limit = HALF[weight_bytes] - (sign > 0)
    weights = np.zeros((rows, columns), np.int64)
    room = (2 * Z_END - 2) // 256 - 2 * columns - 2
    for j in range(columns):
        weights[:, j] = sign * min(limit, room - np.abs(weights).sum(axis=1)[0])
    up, down = np.maximum(weights, 0).sum(axis=1), np.maximum(-weights, 0).sum(axis=1)
    low, high = -Z_END + 256 * (down + columns), Z_END - 1 - 256 * (up + columns)
    return Layer(weights, high if sign > 0 else low, np.full(rows, scale), weight_bytes)


def corner_models():
    """{name: (network at the limits of its formats, every corner of its inputs)}."""
    cases = {}
    for weight_bytes, sign, scale in itertools.product((1, 2), (-1, 1), (1, 65535)):
        widths, outputs = (6, 5), 3
        shapes = zip([*widths, outputs], [6, *widths])
        layers = [limit_layer(r, c, weight_bytes, sign, scale) for r, c in shapes]
        model = MlpModel.from_layers(np.full(6, 20000), np.full(6, 65535), layers)
        ends = (0, 19999, 20000, 20001, 65535)
        corners = np.array(list(itertools.product((0, 65535), repeat=6)) + [[e] * 6 for e in ends], np.uint16)
        cases[f"{weight_bytes} bytes, sign {sign}, scale {scale}"] = model, corners
    return cases


def test_golden_network():
    model, features = golden_case()
    same_everywhere(model, features)
    *outputs, flags = model.predict(features)
    y = (np.array(outputs).T * 128).astype("<i2")
    assert 10 < np.unique(y, axis=0).shape[0] and y.std() > 100 and not np.any(np.abs(y) == 32767)
    crc = zlib.crc32(b"".join(row.tobytes() + bytes([f, 0]) for row, f in zip(y, flags)))
    print(f"golden CRC-32 over 64 predictions of a network, host: {crc:08x}")
    assert crc == GOLDEN_CRC


@pytest.mark.parametrize("seed", range(40))
def test_c_and_numpy_agree_on_random_networks(seed):
    rng = np.random.default_rng(seed)
    hidden = seed % 5
    widths = tuple(int(w) for w in rng.integers(1, 65, hidden))
    model = random_model(rng, int(rng.integers(1, 9)), widths, int(rng.integers(1, 9)),
                         tuple(int(b) for b in rng.integers(1, 3, hidden + 1)))
    wild = rng.integers(0, 65536, (100, model.inputs)).astype(np.uint16)
    y = same_everywhere(model, np.concatenate([inputs_near(rng, model, 200), wild]))
    assert y.std() > 10


@pytest.mark.parametrize("name", corner_models())
def test_c_and_numpy_agree_at_every_corner_of_the_inputs(name):
    model, corners = corner_models()[name]
    same_everywhere(model, corners)


def test_an_image_round_trips(tmp_path):
    model, features = golden_case()
    again = MlpModel.from_layers(model.offset, model.gain_q8, model.layers)
    assert again.image == model.image and again.widths == (16, 13, 5) and again.weight_bytes == (2, 1, 2, 2)
    model.save(tmp_path / "net")
    loaded = MlpModel.load(tmp_path / "net")
    assert loaded.image == model.image and np.array_equal(loaded.predict(features), model.predict(features))


def test_every_flipped_byte_is_noticed():
    model, _ = golden_case()
    for at in range(len(model.image)):
        damaged = bytearray(model.image)
        damaged[at] ^= 0x41
        assert opened(bytes(damaged))[0] < 0
        with pytest.raises(ModelError):
            MlpModel(bytes(damaged))


def test_a_row_that_could_overflow_is_refused_by_one_unit_of_bias():
    for weight_bytes, sign in itertools.product((1, 2), (-1, 1)):
        layer = limit_layer(2, 6, weight_bytes, sign, 100)
        fits = MlpModel.from_layers(np.zeros(6, int), np.full(6, 256), [layer])
        assert opened(fits.image)[0] == lib.SG_OK
        beyond = bytearray(fits.image)
        stored = int.from_bytes(beyond[64:67], "little")
        beyond[64:67] = ((stored + sign) & 0xFFFFFF).to_bytes(3, "little")
        assert opened(resealed(beyond))[0] == lib.SG_E_BOUNDS
        with pytest.raises(ModelError, match="24 bits"):
            MlpModel(resealed(beyond))
        with pytest.raises(ModelError, match="24 bits"):
            MlpModel.from_layers(np.zeros(6, int), np.full(6, 256),
                                 [Layer(layer.weights, layer.bias + sign, layer.scale, weight_bytes)])


def test_tanh_table_as_the_script_makes_it_is_what_the_twin_has():
    assert mlp.tanh_table()[0] == 0 and mlp.tanh_table()[256] == 32767
    text = (CORE / "sg_mlp_table.c").read_text(encoding="utf-8").split("{", 1)[1]
    assert [int(v) for v in re.findall(r"\d+", text)] == list(mlp.tanh_table())
