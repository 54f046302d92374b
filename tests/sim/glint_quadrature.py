# SPDX-License-Identifier: Apache-2.0
"""The glint by adaptive quadrature in numpy, as an independent check: patches of (theta, phi) are
quartered until
two Gauss rules agree. Its surface, normals, windows and lids share no code with sim_c. No face.
"""

import numpy as np
from brute_image import DEG, Eye, smoothstep, transmission, unit, window


def lids_open(person, elevation_deg, opening, point, toward):
    """Share that the lids leave of light from points (head frame, [n, 3]) along unit vectors."""
    upper = person.lid_upper_deg + person.lid_upper_follow * elevation_deg
    lower = person.lid_lower_deg + person.lid_lower_follow * elevation_deg
    meet = lower + person.lid_close_at * (upper - lower)
    upper, lower = ((meet + opening * (edge - meet)) * DEG for edge in (upper, lower))
    rho = np.linalg.norm(point, axis=-1)
    alpha = np.arctan2(point[:, 0], -point[:, 2])
    beta = np.arcsin(point[:, 1] / rho)
    half, rise = person.canthus_deg * DEG, person.canthus_tilt_deg / 45
    up = np.stack([-np.sin(alpha) * np.sin(beta), np.cos(beta), np.cos(alpha) * np.sin(beta)], -1)
    lean = (toward * up).sum(-1) / np.maximum((toward * point).sum(-1) / rho, 0.02)
    share = 1
    for edge, sign in ((upper, 1), (lower, -1)):
        margin = rise * alpha + edge * (1 - (alpha / half) ** 2)
        slope = (rise - 2 * edge * alpha / half**2) / np.cos(beta)
        inside = sign * rho * (margin - beta) / np.sqrt(1 + slope**2)
        hidden = person.lid_thickness_mm * (np.sqrt(lean**2 + 0.01) + sign * lean) / 2
        share = share * smoothstep((inside - hidden) / person.lid_softness_mm) * (inside > 0)
    return share


class Glint:
    """One pair at one gaze; ports as headset.Port."""

    def __init__(self, person, sensor, emitter, azimuth_deg, elevation_deg, opening=1.0):
        self.person, self.eye = person, Eye(person, azimuth_deg, elevation_deg)
        self.state = (elevation_deg, opening)
        self.ports = (sensor, emitter)
        self.at = [self.eye.local(np.subtract(p.position_mm, person.eye_position_mm)) for p in self.ports]
        self.aim = [self.eye.local(p.aim) for p in self.ports]
        apex = np.array([0, 0, self.eye.apex - person.cornea_radius_mm])
        self.alpha2 = person.roughness**2
        for place, port in zip(self.at, self.ports):
            far = np.linalg.norm(place - apex) - 0.9 * person.cornea_radius_mm
            self.alpha2 += (port.lens_radius_mm / (2 * far)) ** 2 / 2

    def half(self, theta, phi):
        """Points, normals, unit vectors to sensor and emitter, distances, slope^2 over alpha^2."""
        ray = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
        point = ray * (1 - self.eye.outside(ray))[..., None]
        normal = self.eye.normal(point)
        away = [place - point for place in self.at]
        far = [np.linalg.norm(a, axis=-1) for a in away]
        away = [a / f[..., None] for a, f in zip(away, far)]
        h = away[0] + away[1]
        along = (normal * h).sum(-1)
        across2 = (np.cross(normal, h) ** 2).sum(-1)
        return ray, point, normal, away, far, h, along, across2

    def integrand(self, theta, phi):
        """Response per d theta d phi."""
        ray, point, normal, away, far, h, along, across2 = self.half(theta, phi)
        seen = ((normal * away[0]).sum(-1) > 0) & ((normal * away[1]).sum(-1) > 0)
        along = np.where(seen, along, 1)
        slope2, length2 = across2 / along**2, (h * h).sum(-1)
        lobe = np.exp(-slope2 / self.alpha2) / (np.pi * self.alpha2) * (length2 / along**2) ** 2
        area = (point**2).sum(-1) / (normal * ray).sum(-1) * np.sin(theta)
        index = self.person.refractive_index
        mirror = 1 - transmission(index, np.clip(np.sqrt(length2) / 2, 1e-12, 1))
        value = seen * lobe * mirror * area / (4 * far[0] ** 2 * far[1] ** 2)
        head = point @ self.eye.axes.T
        for port, place, aim, to in zip(self.ports, self.at, self.aim, away):
            value = value * window(port, place, aim, point)
            value = value * lids_open(self.person, *self.state, head, to @ self.eye.axes.T)
        return value

    def _rule(self, patches, n):
        x, w = np.polynomial.legendre.leggauss(n)
        middle, half = (patches[:, ::2] + patches[:, 1::2]) / 2, (patches[:, 1::2] - patches[:, ::2]) / 2
        theta = middle[:, :1, None] + half[:, :1, None] * x[None, :, None] + 0 * x
        phi = middle[:, 1:, None] + half[:, 1:, None] * x[None, None, :] + 0 * x[:, None]
        value = self.integrand(theta.ravel(), phi.ravel()).reshape(theta.shape)
        return half.prod(1) * (value * w[:, None] * w).sum((1, 2))

    def integrate(self, relative=3e-6, levels=9):
        """(response, estimate of its error)."""
        grid_t, grid_p = np.linspace(0, 105 * DEG, 71), np.linspace(-np.pi, np.pi, 145)
        t, p = (g.ravel() for g in np.meshgrid(grid_t, grid_p, indexing="ij"))
        *_, along, across2 = self.half(t, p)
        # Lobe's reach, and how far the half vector may turn between two nodes, near a site fastest.
        turn = 0.06 + 0.8 / min(np.linalg.norm(place) - self.eye.apex for place in self.at)
        reach = np.arctan(6 * np.sqrt(self.alpha2)) + turn
        near = (np.arctan2(np.sqrt(across2), along) < reach).reshape(71, 145)
        near = near[1:, 1:] | near[1:, :-1] | near[:-1, 1:] | near[:-1, :-1]
        i, j = np.nonzero(near)
        patches = np.stack([grid_t[i], grid_t[i + 1], grid_p[j], grid_p[j + 1]], 1)
        total, error, coarse = 0.0, 0.0, None
        for level in range(levels):
            value, coarse = self._rule(patches, 8), self._rule(patches, 5)
            off = np.abs(value - coarse)
            done = off <= relative * max(value.sum() + total, 1e-30) / (40 + len(patches))
            if level == levels - 1:
                done[:] = True
            total, error = total + value[done].sum(), error + off[done].sum()
            a, b, c, d = patches[~done].T
            if not len(a):
                break
            m, k = (a + b) / 2, (c + d) / 2
            quarters = [(a, m, c, k), (m, b, c, k), (a, m, k, d), (m, b, k, d)]
            patches = np.concatenate([np.stack(q, 1) for q in quarters])
        return total, error
