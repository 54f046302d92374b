# SPDX-License-Identifier: Apache-2.0
"""Hyper-parameters of a Gaussian process in the units of the data, and how they are learnt from it."""

from dataclasses import dataclass, replace

import numpy as np

from .errors import CalibrationError
from .likelihood import Likelihood, learn, polish, thorough


@dataclass(frozen=True)
class Hyper:
    """Kernel parameters in the units of the data.

    length [d] in the kernel's length unit: feature units, but for canberra (a pure number) and cosine
    (rad, the same in all channels); inf drops a channel
    signal_deg, noise_deg, group_deg  standard deviations
    """

    length: np.ndarray
    signal_deg: float
    noise_deg: float
    group_deg: float = 0.0

    @property
    def used(self):
        """bool [d]: channels that the kernel sees."""
        return np.isfinite(self.length)

    def checked(self, channels, dropped):
        """This less the dropped channels. Raises CalibrationError if it does not fit so many channels."""
        length = np.array(self.length, float)
        deviations = self.signal_deg, self.noise_deg, self.group_deg
        if length.shape != (channels,):
            raise CalibrationError(f"{length.size} length scales for {channels} channels", "give one each")
        length[list(dropped)] = np.inf
        if not (np.all(length > 0) and np.isfinite(length).any()):
            raise CalibrationError("length scales must be above 0, a live one finite", "learn them")
        if not (np.isfinite(deviations).all() and self.signal_deg > 0 and min(deviations) >= 0):
            raise CalibrationError("signal_deg must be above 0, noise_deg, group_deg not below", "learn it")
        return replace(self, length=length)

    def lengths(self, kernel):
        """Lengths of those channels, or the one length of a kernel that has only one."""
        return self.length[self.used] if kernel.per_channel else self.length[self.used][:1]


def learnt(gp, restarts, seed, group_noise, rows):
    """Hyper of the greatest marginal likelihood of a GaussianProcess's data; `rows` see likelihood.learn."""
    problem, level, unit = _problem(gp, group_noise)
    return _hyper(gp, learn(problem, gp.length_max, restarts, seed, rows), level, unit, group_noise)


def refined(gp, rows):
    """gp.hyper after a few steps towards the maximum of its likelihood; `rows` see likelihood.polish."""
    grouped = gp.hyper.group_deg > 0
    problem, level, unit = _problem(gp, grouped)
    theta = polish(problem, _theta(gp, level, unit), gp.length_max, rows)
    return _hyper(gp, theta, level, unit, grouped)


def gap(gp, restarts, seed):
    """Log likelihood that gp.hyper lacks of the best that likelihood.thorough finds, nats."""
    problem, level, unit = _problem(gp, gp.hyper.group_deg > 0)
    return thorough(problem, _theta(gp, level, unit), gp.length_max, restarts, seed)


def _theta(gp, level, unit):
    deviations = np.array([gp.hyper.signal_deg, gp.hyper.noise_deg, gp.hyper.group_deg]) / level
    used = [True, not gp.noise_free, gp.hyper.group_deg > 0]
    return np.log(np.r_[gp.hyper.lengths(gp.kernel) / unit, deviations[used]])


def _hyper(gp, theta, level, unit, group_noise):
    value = np.exp(theta)
    length = np.full(gp.x.shape[1], np.inf)
    length[_live(gp)] = value[: len(unit)] * unit
    rest = [float(v * level) for v in value[len(unit) :]]
    return Hyper(length, rest[0], 0.0 if gp.noise_free else rest[1], rest[-1] if group_noise else 0.0)


def _live(gp):
    """Channels that the kernel sees."""
    if gp.hyper is not None:
        return list(np.flatnonzero(gp.hyper.used))
    return [j for j in range(gp.x.shape[1]) if j not in gp.dropped]


def _problem(gp, group_noise):
    """(Likelihood of the data, level [deg] of its gaze, natural units [L] in the hyper-parameters' units)."""
    z, unit, in_features = gp.kernel.natural(gp.x[:, _live(gp)])
    level = float(np.sqrt(np.mean((gp.y - gp.y.mean(axis=0)) ** 2))) or 1.0
    h = np.ones((len(z), {"zero": 0}.get(gp.mean, 1)))
    if gp.mean == "linear":
        x = gp.x[:, [j for j in range(gp.x.shape[1]) if j not in gp.dropped]]
        h = np.hstack([h, (x - x.mean(axis=0)) / x.std(axis=0)])
    data = gp.kernel, z, unit, gp.y / level, h, gp.noise_scale, gp.groups
    return Likelihood(*data, gp.noise_free, group_noise), level, in_features
