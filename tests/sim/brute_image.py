# SPDX-License-Identifier: Apache-2.0
"""The paper's way, as an independent check: render what a sensor sees of the eye, weigh it with its window,
sum.

Shares no code and no method with sim_c: rays are marched to the surface, the iris is found by Snell's law
forward, its
light by differentiating bundles of refracted rays from the emitter. Eye only: no lids, no face, no glint.
"""

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator

DEG = np.pi / 180


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def fick(azimuth_deg, elevation_deg):
    a, e = azimuth_deg * DEG, elevation_deg * DEG
    return np.array([np.sin(a) * np.cos(e), np.sin(e), -np.cos(a) * np.cos(e)])


def smoothstep(t):
    t = np.clip(t, 0, 1)
    return t**3 * (10 + t * (6 * t - 15))


class Eye:
    """The person's eye at one gaze. Eye frame: origin at the centre of rotation, +z out of the cornea."""

    def __init__(self, person, azimuth_deg, elevation_deg):
        self.person, p = person, 1 + person.cornea_asphericity
        limbus, radius = person.limbus_radius_mm, person.cornea_radius_mm
        self.apex = np.sqrt(person.globe_radius_mm**2 - limbus**2) + limbus**2 / (
            radius + np.sqrt(radius**2 - p * limbus**2)
        )
        self.iris_z = self.apex - person.iris_depth_mm
        rest, gaze = np.array([0, 0, -1.0]), fick(azimuth_deg, elevation_deg)
        axis = fick(person.kappa_azimuth_deg, person.kappa_elevation_deg)
        # Listing: turn by the angle between rest and gaze, about their cross product (Rodrigues).
        k = np.cross(rest, gaze)
        sine, cosine = np.linalg.norm(k), rest @ gaze
        k = k / sine if sine > 1e-12 else np.array([1.0, 0, 0])
        z = axis * cosine + np.cross(k, axis) * sine + k * (k @ axis) * (1 - cosine)
        x = unit(np.cross([0.2, 1.0, 0.1], z))
        self.axes = np.stack([x, np.cross(z, x), z], 1)

    def local(self, point):
        return np.asarray(point) @ self.axes

    def sag(self, r2):
        p = 1 + self.person.cornea_asphericity
        return r2 / (self.person.cornea_radius_mm + np.sqrt(self.person.cornea_radius_mm**2 - p * r2))

    def outside(self, point):
        """Distance from the centre minus the surface's there: 0 on the surface."""
        person, p = self.person, 1 + self.person.cornea_asphericity
        distance = np.linalg.norm(point, axis=-1)
        cosine = point[..., 2] / distance
        a = 1 - cosine**2 + p * cosine**2
        b = cosine * (person.cornea_radius_mm - p * self.apex)
        c = self.apex * (2 * person.cornea_radius_mm - p * self.apex)
        cornea = (-b + np.sqrt(b * b + a * c)) / a
        gap = np.abs(cornea - person.globe_radius_mm)
        blend = np.maximum(1 - gap / person.limbus_blend_mm, 0) ** 3 * person.limbus_blend_mm / 6
        return distance - np.maximum(cornea, person.globe_radius_mm) - blend

    def normal(self, point):
        h = 1e-5
        return unit(
            np.stack([self.outside(point + h * e) - self.outside(point - h * e) for e in np.eye(3)], -1)
        )

    def normal_of_cornea(self, q):
        """Unit normals of the unblended cornea over points q [n, 2] of the plane across the axis."""
        p = 1 + self.person.cornea_asphericity
        return unit(np.column_stack([q, np.sqrt(self.person.cornea_radius_mm**2 - p * (q**2).sum(-1))]))

    def whiteness(self, r):
        return smoothstep((r - self.person.limbus_radius_mm) / self.person.limbus_haze_mm + 0.5)


def window(port, position, axis, point):
    direction = point - position
    cosine = unit(direction) @ axis
    tangent2 = 1 / cosine**2 - 1
    return np.where(cosine > 0, np.exp(-tangent2 / (2 * np.tan(port.sigma_deg * DEG) ** 2)), 0)


def transmission(index, cosine):
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    s, p = (cosine - index * inside) / (cosine + index * inside), (inside - index * cosine) / (
        inside + index * cosine
    )
    return 1 - (s * s + p * p) / 2


def refract(eye, position, q):
    """Rays from a place through points q [n, 2] of the cornea: where they meet the iris, and what is
    transmitted.
    """
    r2 = (q**2).sum(-1)
    point = np.column_stack([q, eye.apex - eye.sag(r2)])
    normal = eye.normal_of_cornea(q)
    ray = unit(point - position)
    cosine, n = -(ray * normal).sum(-1), eye.person.refractive_index
    inside = ray / n + ((cosine / n) - np.sqrt(np.maximum(1 - (1 - cosine**2) / n**2, 0)))[:, None] * normal
    t = (eye.iris_z - point[:, 2]) / inside[:, 2]
    return (
        point,
        (point + t[:, None] * inside)[:, :2],
        transmission(n, np.clip(cosine, 1e-9, 1)) * (cosine > 0),
        t > 0,
    )


def iris_light(eye, emitter, position, axis, spacing):
    """Interpolator of the iris's irradiance per axial intensity, from differentiated bundles of rays."""
    grid = np.arange(-6.6, 6.6, spacing)
    q = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    q = q[(q**2).sum(-1) < 6.5**2]
    point, iris, through, good = refract(eye, position, q)
    h = 1e-4
    d = [
        (refract(eye, position, q + s)[1] - refract(eye, position, q - s)[1]) / (2 * h)
        for s in (np.array([h, 0]), np.array([0, h]))
    ]
    stretch = np.abs(d[0][:, 0] * d[1][:, 1] - d[0][:, 1] * d[1][:, 0])
    away = point - position
    distance = np.linalg.norm(away, axis=-1)
    # Area of the cornea over its shadow on the q plane times the cosine of incidence: the ray's cross-
    # section.
    normal = eye.normal_of_cornea(q)
    cross = -(away * normal).sum(-1) / normal[:, 2] / distance
    light = window(emitter, position, axis, point) * cross / distance**2 / stretch * through
    light = light * (1 - eye.whiteness(np.sqrt((q**2).sum(-1))))
    return CloughTocher2DInterpolator(iris[good], light[good], fill_value=0.0)


def eye_response(
    person, sensor, emitter, azimuth_deg, elevation_deg, pupil_mm, pixels, half_width_sigmas=5.0
):
    """(sclera, iris) of one pair, from an image of pixels x pixels; lens radii are ignored."""
    eye = Eye(person, azimuth_deg, elevation_deg)
    s, e = (eye.local(np.subtract(port.position_mm, person.eye_position_mm)) for port in (sensor, emitter))
    s_axis, e_axis = eye.local(sensor.aim), eye.local(emitter.aim)
    u = unit(np.cross(s_axis, [0.1, 0.9, 0.3]))
    half = half_width_sigmas * np.tan(sensor.sigma_deg * DEG)
    tangent = (np.arange(pixels) + 0.5) / pixels * 2 * half - half
    tx, ty = (t.ravel() for t in np.meshgrid(tangent, tangent))
    ray = unit(s_axis + tx[:, None] * u + ty[:, None] * np.cross(s_axis, u))
    solid = (ray @ s_axis) ** 3 * (2 * half / pixels) ** 2
    along = -(ray @ s)
    miss2 = s @ s - along**2
    hit = miss2 < 13.4**2
    ray, solid, along, miss2 = ray[hit], solid[hit], along[hit], miss2[hit]
    t = along - np.sqrt(14.5**2 - miss2)
    for _ in range(150):
        place = s + t[:, None] * ray
        steepness = -(place * ray).sum(-1) / np.linalg.norm(place, axis=-1)
        t = t + 0.7 * eye.outside(place) / np.maximum(steepness, 0.1)
    point = s + t[:, None] * ray
    on = np.abs(eye.outside(point)) < 1e-6
    point, ray, solid = point[on], ray[on], solid[on]
    weight = solid * window(sensor, s, s_axis, point)
    normal, white = eye.normal(point), eye.whiteness(np.hypot(point[:, 0], point[:, 1]))
    white = np.where(point[:, 2] > 0, white, 1.0)
    away = e - point
    distance = np.linalg.norm(away, axis=-1)
    lit = np.maximum((away * normal).sum(-1) / distance, 0) * window(emitter, e, e_axis, point) / distance**2
    sclera = (weight * white * person.albedo_sclera / np.pi * lit).sum()
    q = point[white < 1][:, :2]
    inner = (q**2).sum(-1) < 6.5**2
    # The iris is seen through the unblended cornea: aim again at the conic, where the ray crosses it.
    clear, ray, weight = np.flatnonzero(white < 1)[inner], ray[white < 1][inner], weight[white < 1][inner]
    place = point[clear]
    for _ in range(40):
        r2 = (place[:, :2] ** 2).sum(-1)
        place = (
            place
            + ((eye.apex - eye.sag(np.minimum(r2, 7.0**2))) - place[:, 2])[:, None] * ray / ray[:, 2:] * 0.7
        )
    _, iris, through, good = refract(eye, s, place[:, :2])
    radius = np.hypot(iris[:, 0], iris[:, 1])
    seen = good & (radius > pupil_mm / 2) & (radius < person.limbus_radius_mm)
    light = iris_light(eye, emitter, e, e_axis, 0.1)(iris[seen])
    veil = 1 - eye.whiteness(np.hypot(place[seen, 0], place[seen, 1]))
    out = person.albedo_iris / np.pi / person.refractive_index**2 * light * through[seen] * veil
    return sclera, (weight[seen] * out).sum()
