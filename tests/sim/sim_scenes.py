# SPDX-License-Identifier: Apache-2.0
"""Scenes that the simulator's tests share."""

import numpy as np

from sparsegaze.headset import Headset, Port


def port(position_mm, aim_mm=(0.0, 0.0, -11.0), sigma_deg=10.0, lens_radius_mm=1.0):
    """A Port at a place, looking at a point."""
    direction = np.subtract(aim_mm, position_mm)
    return Port(tuple(position_mm), tuple(direction / np.linalg.norm(direction)), sigma_deg, lens_radius_mm)


def pair(sensor, emitter):
    """A headset of one sensor and one emitter."""
    return Headset("pair", (sensor,), (emitter,))


def six(sigma_deg=10.0, lens_radius_mm=1.5):
    """Six LEDs on the lower half of a ring, aimed at six places of the eye: not the product's placement."""
    ports = []
    for k in range(6):
        angle = np.radians(180 + 36 * k)
        position = (16 * np.cos(angle), 16 * np.sin(angle), -28.0)
        ports.append(
            port(position, (-5 * np.cos(angle), -3 * np.sin(angle), -11.0), sigma_deg, lens_radius_mm)
        )
    return Headset("six", tuple(ports), tuple(ports))


OFF_DIAGONAL = ~np.eye(6, dtype=bool)

# Of a Person: lids out of the way, for what concerns the eye alone.
LIDS_AWAY = dict(
    lid_upper_deg=58.0,
    lid_lower_deg=-58.0,
    canthus_deg=80.0,
    lid_thickness_mm=0.0,
    lid_upper_follow=0.0,
    lid_lower_follow=0.0,
)
