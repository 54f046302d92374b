# SPDX-License-Identifier: Apache-2.0
"""Response maps of the simulated persons that the front end's benchmark uses."""

from pathlib import Path

from frontend_physics import P

from sparsegaze import simulate
from sparsegaze.headset import load_headset
from sparsegaze.person import draw_person

HEADSET = Path(__file__).resolve().parents[2] / "headsets" / "led2gaze.toml"


def maps(seeds, say):
    """{seed: path of the map on the default headset}, computed where it is not known yet."""
    headset, found = load_headset(HEADSET), {}
    for seed in seeds:
        tenths = set()

        def progress(done, seed=seed, tenths=tenths):
            if int(10 * done) not in tenths and done < 1:
                tenths.add(int(10 * done))
                say(f"map of simulated person {seed}: {10 * int(10 * done)} %")

        found[seed] = simulate.response_map(
            headset, draw_person(seed, P.eye.lid_follow_gain), progress=progress
        )
    return found
