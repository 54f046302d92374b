# SPDX-License-Identifier: Apache-2.0
"""sg_health: each fault is named in time, nothing else is, and both ways last."""
import numpy as np
import pytest

from light_reference import CAPS, JUNCTION_PF, NOISE_LSB, PIN_PF, SAMPLE_PF, Board
from sparsegaze._core import ffi, lib

PATIENCE, OCTAVE = lib.SG_HEALTH_PATIENCE, 4096
ABOVE = 3 * OCTAVE // 2        # the middle of the range
OFFSET, GAIN_Q12 = 40000, 2048              # the calibrated range: 40000 .. 48192
GOOD = {"lit_code": 400, "unlit_code": 3, "before_code": 380, "exposure_cycles": CAPS[0],
        "most_cycles": CAPS[0], "feature": 44000, "offset": OFFSET, "gain_q12": GAIN_Q12}


class Health:
    """struct sg_health, looking at channel 2 alone."""

    def __init__(self):
        self.state = ffi.new("struct sg_health *")
        lib.sg_health_start(self.state)

    def look(self, looks=1, channel=2, **changed):
        """Looks in a row; returns the fault bits by look."""
        seen = []
        for _ in range(looks):
            sight = ffi.new("struct sg_health_sight *", {**GOOD, **changed})
            any_fault = lib.sg_health_look(self.state, channel, sight)
            assert any_fault == any(self.state.fault)
            seen.append(self.state.fault[channel])
        return seen


FAULTS = {
    "open": (lib.SG_FAULT_OPEN, {"lit_code": 2, "unlit_code": 1}),
    "short": (lib.SG_FAULT_SHORT, {"lit_code": 1023, "unlit_code": 1023, "exposure_cycles": 64}),
    "covered": (lib.SG_FAULT_LOW, {"feature": OFFSET - OCTAVE - 1}),
    "finger": (lib.SG_FAULT_HIGH, {"feature": OFFSET + 4096 + ABOVE}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_after_patience_and_forgotten_after_as_long(name):
    bit, changed = FAULTS[name]
    health = Health()
    assert health.look(50) == [0] * 50
    assert health.look(PATIENCE, **changed) == [0] * (PATIENCE - 1) + [bit]
    assert health.look(100, **changed) == [bit] * 100
    assert health.look(PATIENCE) == [bit] * (PATIENCE - 1) + [0]


@pytest.mark.parametrize("name", FAULTS)
def test_what_does_not_last_is_no_fault(name):
    _, changed = FAULTS[name]
    health = Health()
    for _ in range(50):                     # a blink: 240 ms of looks 48 ms apart
        assert not any(health.look(PATIENCE - 1, **changed))
        assert not any(health.look(PATIENCE))


@pytest.mark.parametrize("kind,changed", {
    "an octave below, not more": {"feature": OFFSET - OCTAVE},
    "1.5 octaves above the middle, not more": {"feature": OFFSET + 4096 + ABOVE - 1},
    "no model": {"feature": 0, "gain_q12": 0, "offset": 0},
    "dark but short exposed": {"lit_code": 1, "unlit_code": 1, "exposure_cycles": 64},
    "dark with leakage": {"lit_code": 6, "unlit_code": 5},
    "full, unlit not": {"lit_code": 1023, "unlit_code": 600, "exposure_cycles": 64},
    "full at a long exposure": {"lit_code": 1023, "unlit_code": 1023, "exposure_cycles": 400},
}.items())
def test_what_is_no_fault(kind, changed):
    health = Health()
    assert not any(health.look(200, **changed)), kind


def test_the_end_of_the_feature_range_overflows_nothing():
    for offset, gain in ((0, 65535), (65535, 1), (65535, 65535), (0, 1)):
        for feature in (0, 1, 4095, 4096, 32768, 65535):
            health = Health()
            found = health.look(PATIENCE, offset=offset, gain_q12=gain, feature=feature)[-1]
            above = ((feature - offset - ABOVE) * gain) >> 12
            expected = lib.SG_FAULT_LOW if feature + OCTAVE < offset else \
                lib.SG_FAULT_HIGH if feature - offset >= ABOVE and above >= 2048 else 0
            assert found == expected, (offset, gain, feature)


def test_an_open_second_of_a_pair_is_named_although_it_repeats_its_neighbour():
    rng, health = np.random.default_rng(2), Health()
    share = SAMPLE_PF / (SAMPLE_PF + PIN_PF)
    seen = []
    for k in range(60):
        before = 350 + 60 * np.sin(k / 7)
        lit = round(share * before + NOISE_LSB * rng.standard_normal())
        seen.append(health.look(lit_code=lit, unlit_code=2, before_code=round(before))[0])
    assert seen[-1] == lib.SG_FAULT_OPEN and JUNCTION_PF > 0


def test_a_sound_pair_of_that_very_ratio_is_not_open():
    rng, health = np.random.default_rng(3), Health()
    for k in range(3000):                   # eyes move both, but not alike
        before = 350 + 60 * np.sin(k / 7)
        lit = 0.7 * 350 + 30 * np.sin(k / 11 + 1)
        assert health.look(lit_code=round(lit + rng.normal(0, 0.8)), before_code=round(before))[0] == 0
    assert not any(health.look(3000, lit_code=245, before_code=350))   # nor while the eye rests


def test_a_sound_board_has_no_fault_in_any_light():
    for ambient_na in (0, 20, 200):
        board, health = Board(150, ambient_na, exposure=[900] * 6, noise_lsb=NOISE_LSB), Health()
        for _ in range(30):
            reading = board.cycle()
            for first, second in ((5, 0), (1, 4), (2, 3)):
                for i, before in ((first, 0), (second, reading.lit_code[first])):
                    found = health.look(1, i, lit_code=reading.lit_code[i], unlit_code=reading.unlit_code[i],
                                        before_code=before, exposure_cycles=900)
                    assert found == [0]


def test_channels_do_not_share_their_counts_and_an_unknown_channel_does_nothing():
    health = Health()
    for _ in range(PATIENCE):
        for channel in range(6):
            health.look(1, channel, **(FAULTS["open"][1] if channel == 4 else {}))
    assert list(health.state.fault) == [0, 0, 0, 0, lib.SG_FAULT_OPEN, 0]
    sight = ffi.new("struct sg_health_sight *", GOOD)
    assert lib.sg_health_look(health.state, 6, sight) == lib.sg_health_look(health.state, 255, sight) == 1
