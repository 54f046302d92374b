# SPDX-License-Identifier: Apache-2.0
"""The reference (reference.py) judges itself, and then the simulator."""

import numpy as np
import pytest
from random_scenes import random_scenes
from reference import TERMS, reference_states


@pytest.mark.parametrize("name", ["half-closed lids", "random 5"])
def test_a_tighter_goal_changes_less_than_the_estimate(name):
    case = next(c for c in random_scenes() if c.name == name)
    pairs = [(0, 1), (1, 0)]
    rough, estimate, _ = reference_states(case.headset, case.person, case.states, pairs, 1e-4)
    fine, closer, _ = reference_states(case.headset, case.person, case.states, pairs, 3e-6)
    for term in TERMS:
        assert (np.abs(rough[term] - fine[term]) <= estimate[term] + closer[term]).all()
        assert closer[term].max() <= 3.1e-6 * sum(fine.values()).max()


def test_scenes_are_the_same_every_time():
    first, again = random_scenes(), random_scenes(12)
    assert len(first) == 20 and len(again) == 12
    assert first[:12] == again
    assert len({case.name for case in first}) == 20
