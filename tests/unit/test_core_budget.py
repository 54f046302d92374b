# SPDX-License-Identifier: Apache-2.0
"""Cycles, stack and flash of the core's functions, per target, against tests/budget.csv.

On the Cortex-M4 the column of the cycles holds instructions, as QEMU counts them: the target's name says so.
"""
import pathlib

import numpy as np
import pytest

import budget
import core_avr_cases
import core_avr_harness as avr
import core_m4_harness as m4
from budget import judge, judge_all, read
from core_footprint import footprint
from core_models import Parts
from mlp_models import inputs_near, random_model
from sparsegaze._core import ffi, lib

AVR, CORTEX_M4 = "atmega328p", "cortex-m4-instructions"
# The AVR compiler is pinned by requirements.txt; the other is Debian's, whatever it is there.
M4_COMPILER, OTHER_COMPILER_MARGIN = "12.2", 0.3
EXPOSURES = [2544, 1656, 1656, 2544, 2544, 1656]
RUN = {AVR: core_avr_cases.run_cases, CORTEX_M4: m4.run_cases}


def gp_case():
    """run_cases' arguments: the costliest ordinary model, 64 vectors, no kernel 0, 4 guards and a grid."""
    rng = np.random.default_rng(2)
    parts = Parts(offset=np.full(6, 20000), gain_q12=np.full(6, 1500),
                  bias=rng.integers(-2 ** 22, 2 ** 22, 2), trend=rng.integers(-300, 300, (2, 6)),
                  centre=rng.integers(98, 103, (64, 6)),
                  weight=rng.integers(-32768, 32768, (64, 2)),
                  guard=[(0, -2 ** 15, 2 ** 15 - 1, rng.integers(-10, 11, 6)) for _ in range(4)],
                  expected=rng.integers(0, 256, (9, 9, 4)), sigma=rng.integers(1, 200, (9, 9)))
    feature = (20000 + 1600 * 4096 // 1500 + rng.integers(0, 40, (20, 6))).astype(np.uint16)
    return {"body": "sg_track_infer(&view, (const uint16_t *)in, 0, &recentre, (struct sg_gaze *)out);",
            "inputs": feature, "out_bytes": 12, "includes": ["sg_track.h", "sg_err.h"],
            "setup": "struct sg_model_view view;"
                     "const struct sg_affine recentre = { { 9, -9 }, { 1, 2, 3, 4 } };"
                     "if (sg_model_open(&view, image, sizeof image, CASE_SPACE) != SG_OK) return 1;",
            "data": {"image": parts.image()}}


def mlp_case():
    """A network 6-16-2 of 2-byte weights."""
    rng = np.random.default_rng(3)
    model = random_model(rng, 6, (16,), 2, (2, 2))
    return {"body": "sg_mlp_predict(&view, (const uint16_t *)in, scratch, (int16_t *)out, out + 4);",
            "inputs": inputs_near(rng, model, 20), "out_bytes": 5, "includes": ["sg_mlp.h", "sg_err.h"],
            "setup": "struct sg_mlp_view view; static uint16_t scratch[SG_MLP_SCRATCH_MAX];"
                     "if (sg_mlp_open(&view, image, sizeof image, CASE_SPACE) != SG_OK) return 1;",
            "data": {"image": model.image}}


def light_case():
    """Ordinary cycles, the costliest: light that moves, interpolated; the state was settled on the host."""
    rng = np.random.default_rng(4)
    wave = np.round(150 + 15 * np.sin(0.69 * np.arange(80)))[:, None]
    codes = np.concatenate([wave + rng.integers(150, 600, (80, 6)), wave + rng.integers(-1, 2, (80, 6)),
                            np.tile(EXPOSURES, (80, 1)), np.zeros((80, 7))], axis=1).astype(np.uint16)
    light, feature = ffi.new("struct sg_light *"), ffi.new("uint16_t[6]")
    lib.sg_light_start(light, lib.SG_WIRING_LEDS, 15984)
    for row in codes[:40]:
        reading = ffi.new("struct sg_reading *")
        ffi.memmove(reading, row.tobytes(), 50)
        lib.sg_light_add(light, reading)
        lib.sg_light_features(light, feature)
    return {"body": "struct sg_reading reading; memcpy(&reading, in, sizeof reading);"
                    "sg_light_add(&light, &reading);"
                    "uint16_t feature[6]; out[12] = sg_light_features(&light, feature);"
                    "memcpy(out, feature, 12);",
            "inputs": codes[40:], "out_bytes": 13, "includes": ["sg_light.h", "sg_rom.h"],
            "setup": "static struct sg_light light; for (uint8_t k = 0; k < sizeof light; k++)"
                     "    ((uint8_t *)&light)[k] = sg_rom_byte(&settled[k], CASE_SPACE);",
            "data": {"settled": bytes(ffi.buffer(light))}}


def expose_case():
    """Ordinary cycles: nothing full, nothing to acquire."""
    rng = np.random.default_rng(5)
    codes = np.concatenate([rng.integers(300, 350, (60, 6)), rng.integers(2, 9, (60, 6)),
                            np.tile(EXPOSURES, (60, 1))], axis=1)
    expose = ffi.new("struct sg_expose *")
    lib.sg_expose_start(expose, EXPOSURES, EXPOSURES)
    for _ in range(20):
        lib.sg_expose_cycle(expose, ffi.new("struct sg_reading *", {
            "lit_code": [320] * 6, "unlit_code": [5] * 6, "exposure_cycles": EXPOSURES}), lib.SG_WIRING_LEDS)
    return {"body": "struct sg_reading reading = { .held_code = 0 }; memcpy(&reading, in, 36);"
                    "out[0] = sg_expose_cycle(&expose, &reading, 0);",
            "inputs": codes.astype(np.uint16), "out_bytes": 1, "includes": ["sg_expose.h", "sg_rom.h"],
            "setup": "static struct sg_expose expose; for (uint8_t k = 0; k < sizeof expose; k++)"
                     "    ((uint8_t *)&expose)[k] = sg_rom_byte(&settled[k], CASE_SPACE);",
            "data": {"settled": bytes(ffi.buffer(expose))}}


def health_case():
    """Looks at sound channels and at faulty ones."""
    rows = [[lit, 3, 380, 1656, 1656, feature, 40000, 2048] for lit in (0, 266, 400, 1023)
            for feature in (30000, 42000, 64000)]
    return {"body": "struct sg_health_sight sight; memcpy(&sight, in, sizeof sight);"
                    "out[0] = sg_health_look(&health, 3, &sight);",
            "inputs": np.array(rows * 4, np.uint16), "out_bytes": 1, "includes": ["sg_health.h"],
            "setup": "static struct sg_health health; sg_health_start(&health);"}


def packet_case():
    """A gaze into a packet and back."""
    rng = np.random.default_rng(5)
    body = rng.integers(0, 256, (20, 12), np.uint8) * (rng.random((20, 12)) < 0.6)
    return {"body": "struct sg_head head = { .seq = 257, .type = SG_MSG_GAZE };"
                    "int n = sg_wire_encode(&head, in, 12, out);"
                    "sg_wire_decode(out, (size_t)n - 1, &head, out + 40);",
            "inputs": body, "out_bytes": 104, "includes": ["sg_wire.h"]}


# function: the case that runs it
FUNCTIONS = {
    "sg_track_infer": gp_case, "sg_gp_predict": gp_case, "sg_gp_loop": gp_case, "sg_gp_judge": gp_case,
    "sg_model_open": gp_case, "sg_light_add": light_case, "sg_light_features": light_case,
    "sg_expose_cycle": expose_case, "sg_health_look": health_case, "sg_wire_encode": packet_case,
    "sg_wire_decode": packet_case, "sg_mlp_predict": mlp_case}


def footprint_of(target, elf):
    """The Footprint of a program that run_cases of the target has made."""
    if target == AVR:
        objects, prefix, return_bytes = core_avr_cases.core_objects(), avr.avr_tool("avr-nm")[:-2], 2
    else:
        objects, prefix, return_bytes = m4.core_objects(), m4.PREFIX, 0
    files = [path for made in [*objects, *elf.parent.glob("*.o")] for path in [made.with_suffix(".su")]]
    return footprint(elf, [path for path in files if path.exists()], prefix, return_bytes)


@pytest.mark.parametrize("target", RUN)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_cycles_stack_and_flash_of_a_function(name, target, tmp_path):
    result = RUN[target](tmp_path, **FUNCTIONS[name](), wrap=name)
    taken = footprint_of(target, result.elf)
    measured = {"cycles_max": int(max(result.function)), "stack": taken.stack(name),
                "flash": taken.flash[name]}
    print(f"{name},{target},{measured['cycles_max']},{measured['stack']},{measured['flash']},")
    pinned = target == AVR or m4.run([m4.tool("gcc"), "-dumpfullversion"]).startswith(M4_COMPILER)
    judge_all(target, [(name, column, value) for column, value in measured.items()],
              0.0 if pinned else OTHER_COMPILER_MARGIN)


def test_every_function_has_a_budget_on_every_target():
    for target in RUN:
        assert set(FUNCTIONS) <= {name for name, row in read(target).items() if row["flash"] is not None}


def test_a_budget_fails_both_ways():
    limits = {"x": {"cycles_max": 1000}}
    assert judge(limits, "x", "cycles_max", 1000) is None and judge(limits, "x", "cycles_max", 950) is None
    assert "above" in judge(limits, "x", "cycles_max", 1001)
    assert "write 949" in judge(limits, "x", "cycles_max", 949)
    assert judge(limits, "x", "cycles_max", 1300, 0.3) is None and judge(limits, "x", "cycles_max", 1301, 0.3)


def test_asked_to_write_the_file_keeps_every_other_figure(tmp_path, monkeypatch):
    (tmp_path / "b.csv").write_text("name,target,cycles_max,stack,flash,ram\na,x,1,2,,\na,y,3,,,\n")
    monkeypatch.setattr(budget, "FILE", tmp_path / "b.csv")
    monkeypatch.setenv("BUDGET_WRITE", "1")
    judge_all("x", [("a", "cycles_max", 9), ("b", "flash", 7)])
    assert (tmp_path / "b.csv").read_text() == ("name,target,cycles_max,stack,flash,ram\n"
                                                "a,x,9,2,,\na,y,3,,,\nb,x,,,7,\n")
    monkeypatch.delenv("BUDGET_WRITE")
    with pytest.raises(AssertionError, match="a: cycles_max 10 is above its budget of 9; b: .*write 5"):
        judge_all("x", [("a", "cycles_max", 10), ("b", "flash", 5)])


# What remains of a stack that was painted is measured by the program itself, in its last case.
PAINTED = {
    AVR: ("extern uint8_t _end; for (uint8_t *p = &_end; p < (uint8_t *)SP - 8; p++) *p = 0xA5;",
          "{ const uint8_t *p = &_end; while (*p == 0xA5) p++;"
          " *(uint16_t *)(out + OUT) = (uint16_t)(SP - (uint16_t)p) + 1; }"),
    CORTEX_M4: ("", "*(uint16_t *)(out + OUT) = 8192 - boot_stack_free();"),
}


@pytest.mark.parametrize("target", RUN)
@pytest.mark.parametrize("name", ["sg_track_infer", "sg_mlp_predict"])
def test_the_stack_stated_is_the_stack_seen(name, target, tmp_path):
    case = FUNCTIONS[name]()
    place = -(-case["out_bytes"] // 4) * 4
    paint, look = PAINTED[target]
    case["setup"] += paint
    case["body"] += look.replace("OUT", str(place))
    case["out_bytes"] = place + 4
    result = RUN[target](tmp_path, **case)
    seen = int(result.output[-1, place:place + 2].view(np.uint16)[0])
    taken = footprint_of(target, result.elf)
    stated = taken.stack(name)
    if target == CORTEX_M4:
        seen -= taken.own["main"] + taken.own["boot_reset"]
    print(f"{name}, {target}: stated {stated}, seen {seen} bytes")
    assert stated - 16 <= seen <= stated
