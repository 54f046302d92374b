# SPDX-License-Identifier: Apache-2.0
"""Two scenes that a mesh renderer can express too, and their triangle meshes.

eye     an open eye with no lids: sclera (Lambertian, white from the limbus outwards) and the mirror of the
whole
        front. No iris (no mesh renderer lights one behind a cornea from a point), no face. Point-like ports,
        aimed at the middle of the eye so that little is seen of where our model's widest lids still are; the
        roughness is what the default headset's lenses widen a tear film's lobe to.
face    the whole face with closed lids, Lambertian, lit and seen by point-like ports.
"""

from dataclasses import replace

import numpy as np

from sparsegaze.headset import Headset
from sparsegaze.person import Person
from sparsegaze.scene import c_person, simulator

AIM_MM = (0.0, 0.0, -11.0)
EYE_PERSON = replace(
    Person(),
    lid_upper_deg=59.0,
    lid_lower_deg=-59.0,
    canthus_deg=84.0,
    canthus_tilt_deg=0.0,
    lid_thickness_mm=0.0,
    lid_upper_follow=0.0,
    lid_lower_follow=0.0,
    albedo_iris=0.0,
    albedo_skin=0.0,
    roughness=0.05,
)
FACE_PERSON = Person()
RINGS, SPOKES, LAST_DEG = 700, 1440, 120.0  # of the eye's mesh: 2.0e6 triangles
FACE_STEP_MM = 0.1  # 8.2e5 triangles
SKIN_MM = (-34.0, 30.0, -32.0, 32.0)  # x from, to, y from, to: where sim_face.c has skin


def point_like(headset, aim_mm=None):
    """The headset with lenses of no size; its ports aimed at one place when that is given."""

    def of(port):
        if aim_mm is None:
            return replace(port, lens_radius_mm=0.0)
        aim = np.subtract(aim_mm, port.position_mm)
        return replace(port, lens_radius_mm=0.0, aim=tuple(float(v) for v in aim / np.linalg.norm(aim)))

    return Headset(
        headset.name + ", point-like", tuple(map(of, headset.sensors)), tuple(map(of, headset.emitters))
    )


def eye_mesh(person, rings=RINGS, spokes=SPOKES):
    """{vertex, normal, albedo, triangle} of the blended profile, eye frame (+z out of the cornea), mm.

    Normals are the profile's own at the vertices, so that a renderer interpolates them to second order.
    """
    ffi, lib = simulator()
    made, h = c_person(ffi, person), 1e-4

    def radius(degrees):
        return np.array([lib.sim_person_profile_mm(made, d) for d in degrees])

    degrees = np.linspace(0.0, LAST_DEG, rings + 1)
    rho, slope = radius(degrees), (radius(degrees + h) - radius(degrees - h)) / (2 * np.radians(h))
    s, c = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    length = np.hypot(rho, slope)
    phi = 2 * np.pi * np.arange(spokes) / spokes

    def around(out, up):
        up = np.broadcast_to(up[:, None], (len(up), spokes))
        return np.stack([out[:, None] * np.cos(phi), out[:, None] * np.sin(phi), up], -1).reshape(-1, 3)

    white = step((rho * s - person.limbus_radius_mm) / person.limbus_haze_mm + 0.5)
    white[degrees > 90] = 1.0
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rings), np.arange(spokes), indexing="ij"))
    a, b = i * spokes + j, i * spokes + (j + 1) % spokes
    return {
        "vertex": around(rho * s, rho * c),
        "normal": around((rho * s - slope * c) / length, (rho * c + slope * s) / length),
        "albedo": np.repeat(white * person.albedo_sclera, spokes),
        "triangle": np.concatenate(
            [np.column_stack([a, a + spokes, b + spokes]), np.column_stack([a, b + spokes, b])[spokes:]]
        ),
    }


def face_mesh(person, step_mm=FACE_STEP_MM):
    """{vertex, normal, albedo, triangle} of the face with closed lids, head frame, mm."""
    ffi, lib = simulator()
    made, e = c_person(ffi, person), 0.01
    x_from, x_to, y_from, y_to = SKIN_MM
    nx, ny = round((x_to - x_from) / step_mm) + 1, round((y_to - y_from) / step_mm) + 1
    y, x = np.meshgrid(np.linspace(y_from, y_to, ny), np.linspace(x_from, x_to, nx), indexing="ij")

    def height(dx=0.0, dy=0.0):
        points = zip((x + dx).ravel(), (y + dy).ravel())
        return np.array([lib.sim_person_face_mm(made, px, py) for px, py in points])

    w = height()
    wx, wy = (height(e) - height(-e)) / (2 * e), (height(0, e) - height(0, -e)) / (2 * e)
    normal = np.column_stack([-wx, -wy, -np.ones_like(w)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    j, i = (index.ravel() for index in np.meshgrid(np.arange(ny - 1), np.arange(nx - 1), indexing="ij"))
    a = j * nx + i
    return {
        "vertex": np.column_stack([x.ravel(), y.ravel(), -w]),
        "normal": normal,
        "albedo": np.full(nx * ny, person.albedo_skin),
        "triangle": np.concatenate(
            [np.column_stack([a, a + nx, a + 1]), np.column_stack([a + nx, a + nx + 1, a + 1])]
        ),
    }


def step(t):
    """C2 from 0 to 1."""
    t = np.clip(t, 0.0, 1.0)
    return t**3 * (10 + t * (6 * t - 15))


def direction(azimuth_deg, elevation_deg):
    """Unit vector of Fick angles, head frame."""
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.sin(a) * np.cos(e), np.sin(e), -np.cos(a) * np.cos(e)])


def eye_axes(person, azimuth_deg, elevation_deg):
    """Columns: the eye's axes in the head frame, by Listing's law; its roll is immaterial, the eye is
    round.
    """
    rest, gaze = direction(0.0, 0.0), direction(azimuth_deg, elevation_deg)
    v, cosine = np.cross(rest, gaze), rest @ gaze
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    turn = np.eye(3) + cross + cross @ cross / (1 + cosine)
    z = turn @ direction(person.kappa_azimuth_deg, person.kappa_elevation_deg)
    x = np.cross([0.2, 1.0, 0.1], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], 1)


def port_row(port, person, axes=None):
    """[7] position, aim, tan(sigma) of a port in the frame of a mesh: the head's, or an eye's with these
    axes.
    """
    axes = np.eye(3) if axes is None else axes
    position = np.subtract(port.position_mm, person.eye_position_mm)
    return np.concatenate([position @ axes, np.array(port.aim) @ axes, [np.tan(np.radians(port.sigma_deg))]])
