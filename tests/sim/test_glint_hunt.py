# SPDX-License-Identifier: Apache-2.0
"""No glint is lost: symmetric and round-number geometry, sites on and beside the eye's axis, nearly tangent
ports and any width of the lobe, against the reference's own search and between finenesses.
"""

from dataclasses import replace

import numpy as np
import pytest
from reference import reference_states
from sim_scenes import LIDS_AWAY, port

from sparsegaze.errors import SceneError
from sparsegaze.headset import Headset
from sparsegaze.person import draw_person, nominal_person
from sparsegaze.scene import Scene

KINDS = ("mirrored", "round", "axis", "tangent", "any")
# No face, and lids as wide and soft as can be: in grazing views a sharp margin takes higher fineness.
BARE = dict(LIDS_AWAY, lid_softness_mm=3.0, brow_mm=0.0, nose_mm=0.0, cheek_mm=0.0)


def hunted(kind, seed):
    """(headset of four places, person, gazes [(azimuth, elevation)]) of a kind."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    person = nominal_person() if rng.random() < 0.5 else draw_person(seed)
    person = replace(person, roughness=10 ** rng.uniform(-3, -0.5), **BARE)
    if rng.random() < 0.3:
        person = replace(person, limbus_blend_mm=rng.uniform(0.1, 0.6))
    if kind in ("mirrored", "axis"):
        kappa = (0.0, 0.0) if rng.random() < 0.5 else (5.0, -1.0)
        person = replace(person, kappa_azimuth_deg=kappa[0], kappa_elevation_deg=kappa[1])
    gazes = [tuple(rng.uniform(-25, 25, 2)) for _ in range(3)]
    if kind != "any":
        gazes = [(float(rng.choice([-5, 0, 5])), float(np.round(g[1]))) for g in gazes]
    lens = rng.choice([0.0, 0.0, 0.5, 1.5, 3.0])
    places = []
    for k in range(2):
        turn, off = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(5, 60))
        if kind == "axis":
            off = np.radians(rng.choice([0.0, 1e-6, 0.1, 2.0]))
        if kind == "tangent":
            off = np.radians(rng.uniform(60, 88))
        at = np.array([np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn), -np.cos(off)])
        at *= rng.uniform(20, 60)
        if kind in ("round", "mirrored"):
            at = np.round(at)
        # Its mirror image, or any other place.
        other = at * (-1, 1, 1) if kind in ("mirrored", "axis") or k else at * (0.6, -0.7, 1.3)
        places += [at, other]
    ports = tuple(port(tuple(p), (0, 0, -11), 40.0, float(lens)) for p in places)
    return Headset(kind, ports, ports), person, gazes


def differences(kind, seed, reference):
    """Largest differences over gazes and pairs, of the brightest: {what: difference}; none where a place is
    impossible."""
    headset, person, gazes = hunted(kind, seed)
    got = {}
    try:
        for q in (0.5, 1.0, 4.0):
            scene = Scene(headset, person, quality={"glint": q, "face": 0.1})
            got[q] = np.array([scene.glint(*g, 1.0)[0].ravel() for g in gazes])
    except SceneError:
        return {}
    peak = max(got[4.0].max(), 1e-8)
    off = {q: np.abs(got[q] - got[4.0]).max() / peak for q in (0.5, 1.0)}
    if reference:
        states = [(*gazes[0], 3.5, 1.0)]
        exact, error, _ = reference_states(
            headset, person, states, None, 2e-4, terms=("glint",), scale=float(peak)
        )
        off["reference"] = np.abs(got[4.0][0] - exact["glint"]).max() / peak
        off["estimate"] = error["glint"].max() / peak
    return off


@pytest.mark.parametrize("kind", KINDS)
def test_no_glint_is_lost(kind):
    worst, scenes = {}, 0
    for seed in range(5):
        off = differences(kind, seed, seed == 1 + (kind == "tangent"))
        scenes += bool(off)
        for what, one in off.items():
            worst[what] = max(worst.get(what, 0.0), float(one))
    print(kind, scenes, {what: "%.1e" % off for what, off in worst.items()})
    assert scenes >= 3
    assert worst["estimate"] < 4e-4
    grazing = 10 if kind == "tangent" else 1
    assert worst["reference"] < 3e-4
    assert worst[1.0] < 1e-3 * grazing and worst[0.5] < 1e-2 * grazing
