# SPDX-License-Identifier: Apache-2.0
"""sg_mlp on the host: against its arithmetic in numpy integers, at its extremes, and on damaged images."""
import decimal
import itertools
import re
import zlib

import numpy as np
import pytest

import core_avr_harness as avr
from mlp_models import filled_layer, golden_case, inputs_near, random_model
from sparsegaze import mlp
from sparsegaze._core import ffi, lib
from sparsegaze.errors import ModelError
from sparsegaze.mlp import HALF, Z_END, Layer, MlpModel, emulate
from test_core_layout import layout_hash

GOLDEN_CRC = 0x8cff9545


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


def extreme_activations(layer, row, sign):
    """The activations that make a row's z as large (sign 1) or as small (-1) as it can be, one column after
    the other: columns only meet in the rounding of a half."""
    a = np.arange(65536)
    best = np.zeros(layer.weights.shape[1], np.int64)
    for j, w in enumerate(layer.weights[row]):
        stored = int(w) + HALF[layer.weight_bytes]
        if layer.weight_bytes == 1:
            part = 2 * (stored * a >> 8) - a
        else:
            part = 2 * ((stored >> 8) * a + (stored & 255) * (a >> 8) - 128 * a) + (a & 255)
        best[j] = a[np.argmax(sign * part)]
    return best


@pytest.mark.parametrize("seed", range(6))
def test_no_activations_whatever_leave_24_bits(seed):
    rng = np.random.default_rng(seed)
    layer = filled_layer(rng, 8, int(rng.integers(1, 65)), 1 + seed % 2, 12000)
    up, down = np.maximum(layer.weights, 0).sum(axis=1), np.maximum(-layer.weights, 0).sum(axis=1)
    columns = layer.weights.shape[1]
    for sign, bias in ((1, Z_END - 1 - 256 * (up + columns)), (-1, -Z_END + 256 * (down + columns))):
        edge = Layer(layer.weights, bias, layer.scale, layer.weight_bytes)     # the last bias that is allowed
        for row in range(8):
            a = extreme_activations(edge, row, sign)
            z = int(mlp.whole_sums(edge, a[None])[0, row])
            assert -Z_END <= z < Z_END
            weight = int(np.abs(layer.weights[row]).sum())
            assert sign * z >= Z_END - 1 - 512 * columns - weight // 256    # and the bound is not idle


def test_every_product_is_as_close_to_the_exact_one_as_the_header_says():
    a, w = np.arange(65536), np.arange(256)[:, None]
    short = (w * a >> 8) - a / 2 - (w - 128) * a / 256
    assert -1 < short.min() and short.max() == 0
    low = np.arange(256)
    long = low / 2 - low[:, None] * low / 256                  # L >> 1 less what is left out
    about = long - long.mean(axis=1, keepdims=True)
    print(f"2-byte products, about their mean: within {np.abs(about).max():.1f}, {about.std():.1f} rms of z")
    assert -127 < long.min() and long.max() < 128 and np.abs(about).max() < 64 and about.std() < 22


@pytest.mark.parametrize("seed", range(8))
def test_changed_images_that_still_open_are_evaluated_alike_and_never_wrap(seed):
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(1, 9)), (5, 2, 6)[:seed % 4], 1 + seed % 3, (1, 2, 1, 2)[:seed % 4 + 1])
    model, opened_count = random_model(rng, *shape), 0
    for at in range(8, len(model.image)):
        changed = bytearray(model.image)
        changed[at] ^= int(rng.integers(1, 256))
        changed = resealed(changed)
        verdict, _ = opened(changed)
        try:
            again = MlpModel(changed)
        except ModelError:
            assert verdict < 0
            continue
        assert verdict == lib.SG_OK
        opened_count += 1
        features = rng.integers(0, 65536, (5, again.inputs)).astype(np.uint16)
        same_everywhere(again, features)
        a = mlp.activations(again, features)[0]
        for layer in again.layers:
            z = mlp.whole_sums(layer, a)
            assert np.array_equal(z, mlp.sums(layer, a))
            a = mlp.squash(z, layer.scale)
    assert opened_count > len(model.image) // 5


@pytest.mark.parametrize("weight,bias", [(128, 0), (128, 32768), (-128, 0), (-128, -32768)])
def test_every_argument_of_tanh(weight, bias):
    # A weight of 128 makes z = a >> 1 exactly, a scale of 256 makes u = |z|: together every argument of
    # either sign. The output's weight makes y = t * 127.5 * 514 / 2^16 of it.
    x = np.arange(65536, dtype=np.uint16)[:, None]
    hidden = Layer(np.array([[weight]]), np.array([bias]), np.array([256]), 2)
    last = Layer(np.array([[32640]]), np.array([-127 * 32768 - 16384]), np.array([514]), 2)
    model = MlpModel.from_layers(np.array([0]), np.array([256]), [hidden, last])
    y = same_everywhere(model, x)[:, 0]
    z = mlp.whole_sums(hidden, mlp.activations(model, x)[0])[:, 0]
    first = abs(bias)
    assert set(range(first, first + 32768)) <= set(np.abs(z))
    t = mlp.squash(z[:, None], hidden.scale)[:, 0] - mlp.ONE
    worst = np.abs(t - 32768 * np.tanh(z * np.log(2) / 8192)).max()
    print(f"tanh from {z.min()} to {z.max()}: worst error {worst:.2f} * 2^-15 (header: 1.8)")
    assert worst < 1.8 and np.all(t[z == 0] == 0) and np.all(np.diff(t) * np.sign(weight) >= 0)
    assert np.abs(y - t * (127.5 * 514 / 65536)).max() <= 1


def test_tanh_is_odd_and_saturates():
    z = np.arange(-200000, 200001)
    t = mlp.squash(z, 300) - mlp.ONE
    assert np.array_equal(t, -t[::-1]) and t[0] == -32767 and t[-1] == 32767
    assert mlp.squash(np.array([-Z_END, Z_END - 1]), 65535).tolist() == [1, 65535]


def test_tanh_table_against_60_digits():
    with decimal.localcontext() as context:
        context.prec = 60
        for i, level in enumerate(mlp.tanh_table()):
            power = decimal.Decimal(2) ** (decimal.Decimal(i) / 16)         # e^2x
            exact = 32768 * (power - 1) / (power + 1)
            raised = float(int(level) - exact)
            assert -0.51 <= raised < 1.25 or i == 256 and level == 32767    # by at most 0.74, then rounded


def test_layout_belongs_to_its_version():
    assert {1: "8522432f36021c50"}[lib.SG_MLP_VERSION] == layout_hash("sg_mlp.h")


def test_the_structs_are_those_of_numpy_and_of_the_avr(tmp_path):
    head = ffi.typeof("struct sg_mlp_head")
    places = {name: field.offset for name, field in head.fields}
    assert mlp.HEAD.itemsize == ffi.sizeof(head) == 64
    assert {name: mlp.HEAD.fields[name][1] for name in mlp.HEAD.names} == places
    source = tmp_path / "places.c"
    lines = [f'_Static_assert(offsetof(struct sg_mlp_head, {n}) == {at}, "");' for n, at in places.items()]
    source.write_text('#include "sg_mlp.h"\n' + "\n".join(lines) + "\n", encoding="utf-8")
    avr.run([avr.avr_tool("avr-gcc"), *avr.AVR_FLAGS, "-c", source, "-o", tmp_path / "places.o"])


def test_verdicts_come_in_the_order_that_the_header_states():
    model, _ = golden_case()
    image = bytearray(model.image)
    assert opened(bytes(image), 63)[0] == lib.SG_E_SHORT
    assert opened(bytes(image), len(image) - 1)[0] == lib.SG_E_SHORT
    for at, value, verdict in ((0, 0, lib.SG_E_MAGIC), (10, 2, lib.SG_E_VERSION), (12, 0, lib.SG_E_BOUNDS),
                               (12, 9, lib.SG_E_BOUNDS), (13, 9, lib.SG_E_BOUNDS), (14, 5, lib.SG_E_BOUNDS),
                               (16, 65, lib.SG_E_BOUNDS), (19, 1, lib.SG_E_BOUNDS), (20, 3, lib.SG_E_BOUNDS),
                               (24, 1, lib.SG_E_BOUNDS), (8, 1, lib.SG_E_BOUNDS), (70, 1, lib.SG_E_CRC)):
        changed = bytearray(image)
        changed[at] = value
        assert opened(bytes(changed))[0] == verdict, at
    for at in (15, 25, 31, 56, 63):                             # reserved, pad, inputs not in use
        changed = bytearray(image)
        changed[at] = 1
        assert opened(resealed(changed))[0] == lib.SG_E_BOUNDS, at
        with pytest.raises(ModelError):
            MlpModel(resealed(changed))


def test_a_row_too_many_must_say_nothing():
    model = random_model(np.random.default_rng(0), 3, (), 1, (1,))
    assert opened(model.image)[0] == lib.SG_OK
    changed = bytearray(model.image)
    changed[-1] = 1
    assert opened(resealed(changed))[0] == lib.SG_E_BOUNDS
    with pytest.raises(ModelError, match="row too many"):
        MlpModel(resealed(changed))


def test_saturated_outputs_are_flagged_and_clamped_inputs_too():
    layer = Layer(np.array([[32000], [100]]), np.array([0, 0]), np.array([65535, 1]), 2)
    model = MlpModel.from_layers(np.array([100]), np.array([256]), [layer])
    first, second, flags = model.predict(np.array([[100], [101], [99], [65535]], np.uint16))
    assert flags.tolist() == [0, 0, 4, 4] and first[3] == 32767 / 128 and abs(second[3]) < 1
    assert first[0] == first[2] and second[0] == second[2]


def test_files_that_are_no_networks(tmp_path):
    model, _ = golden_case()
    for name, data, message in (("empty", b"", "not a sparsegaze network"), ("text", b"hello" * 30, "not a"),
                                ("head", model.image[:40], "cut off"), ("cut", model.image[:-1], "cut off"),
                                ("long", model.image + b"x", "too many")):
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(ModelError, match=message) as caught:
            MlpModel.load(path)
        assert str(path) in caught.value.message and caught.value.remedy
    with pytest.raises(ModelError, match="cannot read"):
        MlpModel.load(tmp_path / "none")
    with pytest.raises(ModelError, match="cannot write"):
        model.save(tmp_path / "none" / "net")


@pytest.mark.parametrize("features,message", [
    (np.zeros((3, 5), np.uint16), "6 inputs"), (np.zeros(6, np.uint16), "6 inputs"),
    (np.full((2, 6), np.nan), "whole numbers"), (np.full((2, 6), 65536), "whole numbers"),
    (np.full((2, 6), -1), "whole numbers"), (np.full((2, 6), 0.5), "whole numbers")])
def test_features_that_do_not_fit_are_refused(features, message):
    model, _ = golden_case()
    for evaluate in (model.predict, lambda f: emulate(model, f)):
        with pytest.raises(ModelError, match=message):
            evaluate(features)


def test_no_rows_are_no_error():
    model, _ = golden_case()
    *outputs, flags = model.predict(np.zeros((0, 6), np.uint16))
    assert [len(v) for v in (*outputs, flags)] == [0, 0, 0]


@pytest.mark.parametrize("rows,columns,message", [(65, 6, "hidden layers"), (0, 6, "hidden layers"),
                                                  (4, 5, "make no network")])
def test_shapes_that_do_not_fit_are_refused(rows, columns, message):
    rng = np.random.default_rng(0)
    layers = [Layer(np.zeros((rows, columns), int), np.zeros(rows, int), np.ones(rows, int), 1),
              filled_layer(rng, 2, rows or 1, 1, 1000)]
    if rows == 0:
        layers[1] = Layer(np.zeros((2, 0), int), np.zeros(2, int), np.ones(2, int), 1)
    with pytest.raises(ModelError, match=message):
        MlpModel.from_layers(np.zeros(6, int), np.full(6, 256), layers)


def test_tanh_table_as_the_script_makes_it_is_what_the_twin_has():
    assert mlp.tanh_table()[0] == 0 and mlp.tanh_table()[256] == 32767
    text = (avr.CORE / "sg_mlp_table.c").read_text(encoding="utf-8").split("{", 1)[1]
    assert [int(v) for v in re.findall(r"\d+", text)] == list(mlp.tanh_table())
