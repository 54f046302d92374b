# SPDX-License-Identifier: Apache-2.0
"""The paper's way, image times window, summed, against the integrals; and what it gets wrong."""

from dataclasses import replace

import numpy as np
import pytest
from sim_scenes import pair, port

from sparsegaze.errors import SceneError
from sparsegaze.image import ImageMethod, expose, image_response, view
from sparsegaze.person import draw_person, nominal_person
from sparsegaze.scene import Scene

# A pinhole has no lens: all lenses are points here, so that both ways mean the same.
SENSOR = port((3.87, -15.52, -28.0), (7.5, 1.5, -11.0), 8.5, 0.0)
EMITTER = port((14.62, -6.51, -28.0), (1.5, -6.5, -11.0), 8.5, 0.0)
HEADSET = pair(SENSOR, EMITTER)
PERSON = replace(nominal_person(), roughness=0.05)
GAZES = [(0, 0), (10, -5), (-12, 8), (20, -15), (5, 17)]
FINE = dict(sclera=3, iris=2, glint=2)


def direct(scene, part, gaze, pupil_mm=3.5, lids=1.0):
    """[sensor, emitter] of one part by the integrals."""
    return scene.glint(*gaze, lids)[0] if part == "glint" else scene.smooth(*gaze, pupil_mm, lids, part)[0, 0]


def errors(part, pixels, gazes=GAZES, person=PERSON, headset=HEADSET, **options):
    """Image less integral of one part, of the mean total over these gazes: [gaze]."""
    scene = Scene(headset, person, quality=FINE)
    method = ImageMethod(headset, person, pixels=pixels, half_width_sigmas=5.0, **options)
    mean = np.mean([scene.response(*gaze) for gaze in gazes])
    return np.array(
        [(method.response(*gaze, parts=(part,)) - direct(scene, part, gaze))[0, 0] / mean for gaze in gazes]
    )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("part, bar", [("face", 1e-5), ("sclera", 1e-6), ("iris", 2e-4), ("glint", 1e-6)])
def test_more_pixels_come_closer_to_the_integral(part, bar):
    coarse, fine = rms(errors(part, 48)), rms(errors(part, 384))
    assert fine < bar and fine < coarse / 10
