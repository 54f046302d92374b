# SPDX-License-Identifier: Apache-2.0
"""Where targets are shown: to a simulated person (exact, in device time) or full screen to a real one.

A screen is started with targets and their onsets in device time, told the time once per frame by `tick`, and
asked afterwards when each target really appeared (`onsets_us`). It never decides what is shown when; the plan
does.
"""

import math

from .errors import CalibrationError


def to_millimetres(target_deg, distance_mm):
    """Fick (azimuth, elevation) in degrees -> (right, up) in mm from the centre of a flat screen."""
    azimuth, elevation = (math.radians(v) for v in target_deg)
    return distance_mm * math.tan(azimuth), distance_mm * math.tan(elevation) / math.cos(azimuth)


class Display:
    """Geometry of a flat display in front of one eye.

    pixels (width, height); width_mm of the lit area (or of its virtual image behind a lens); distance_mm from
    the eye. Pixels are taken as square.
    """

    def __init__(self, pixels, width_mm, distance_mm):
        if not (width_mm > 0 and distance_mm > 0):
            raise CalibrationError(
                "the screen's width and distance must be positive lengths in mm",
                "measure them and pass --width-mm and --distance-mm",
            )
        self.pixels = tuple(pixels)
        self.mm_per_pixel = width_mm / pixels[0]
        self.distance_mm = float(distance_mm)

    def to_pixels(self, target_deg):
        """(azimuth, elevation) in degrees -> (x, y) in pixels, y down, floats."""
        right, up = to_millimetres(target_deg, self.distance_mm)
        return self.pixels[0] / 2 + right / self.mm_per_pixel, self.pixels[1] / 2 - up / self.mm_per_pixel

    def pixels_per_degree(self):
        """At the centre."""
        return self.distance_mm * math.tan(math.radians(1.0)) / self.mm_per_pixel

    def reach_deg(self, margin_deg=1.0):
        """Largest (azimuth, elevation) such that the corner target still fits with a margin, degrees."""
        half_w = self.pixels[0] / 2 * self.mm_per_pixel
        half_h = self.pixels[1] / 2 * self.mm_per_pixel
        azimuth = math.degrees(math.atan(half_w / self.distance_mm)) - margin_deg
        elevation = math.degrees(
            math.atan(half_h * math.cos(math.radians(max(azimuth, 0.0))) / self.distance_mm)
        )
        return max(azimuth, 0.0), max(elevation - margin_deg, 0.0)


class VirtualScreen:
    """Targets scheduled on a virtual Nano: the simulated person follows them, to the microsecond.

    control  VirtualControl of the running virtual Nano
    """

    name = "simulated person"

    def __init__(self, control):
        self.control = control
        self.offset_us = None  # device time minus the virtual Nano's own time, us
        self._onsets = []

    def open(self, device):
        """Learn how device time and the virtual Nano's time relate, by pings between looks at its clock."""
        low, high = None, None
        for _ in range(5):
            before = self.control.time().us
            pong = device.ping()
            after = self.control.time().us
            least, most = pong.tx_us - after, pong.rx_us - before
            low = least if low is None else max(low, least)
            high = most if high is None else min(high, most)
        self.offset_us = int(round((low + high) / 2))
        self.control.targets_clear()

    def reach_deg(self):
        """No limit."""
        return None

    def look(self, target_deg, now_us):
        """Show one target from now on, outside any plan."""
        self.control.target(now_us - self.offset_us, *target_deg)

    def start(self, targets_deg, onsets_us, dwell_s):
        """Schedule the whole plan at once."""
        for (azimuth, elevation), onset in zip(targets_deg, onsets_us):
            self.control.target(int(onset) - self.offset_us, float(azimuth), float(elevation))
        self._onsets = [int(v) for v in onsets_us]

    def tick(self, now_us):
        """Nothing to draw."""

    def onsets_us(self):
        """Device times at which the targets appeared: as scheduled."""
        return self._onsets

    def close(self):
        """Leave the last target where it is."""


class WindowScreen:
    """Full-screen targets for a real person, through SDL (pygame-ce, the `screen` extra).

    A dot with a ring that shrinks onto it during the first 0.4 s draws the eye. Esc or closing the window
    raises KeyboardInterrupt. distance_mm, width_mm: see Display; full_screen False opens a window of `size`
    pixels.
    """

    name = "screen"
    RING_S, RING_DEG, DOT_DEG = 0.4, 1.6, 0.35
    REFRESH_US = 15_000
    GROUND, INK, RING = (48, 48, 48), (235, 235, 235), (250, 170, 60)

    def __init__(self, distance_mm=600.0, width_mm=530.0, full_screen=True, size=(1280, 720)):
        try:
            import pygame
        except ImportError:
            raise CalibrationError(
                "showing targets on a real screen needs pygame-ce",
                'install it: pip install "sparsegaze[screen]"',
            ) from None
        self._pygame = pygame
        try:
            pygame.display.init()
            flags = pygame.FULLSCREEN if full_screen else 0
            self._surface = pygame.display.set_mode((0, 0) if full_screen else size, flags)
            pygame.display.set_caption("sparsegaze: look at the dot")
            pygame.mouse.set_visible(False)
        except pygame.error as error:
            pygame.display.quit()
            raise CalibrationError(
                f"no screen to show targets on ({error})",
                "run this at a graphical desktop, or calibrate a virtual Nano",
            ) from None
        try:
            self.display = Display(self._surface.get_size(), width_mm, distance_mm)
        except CalibrationError:
            self.close()
            raise
        self._shown = (0.0, 0.0)
        self._begin([], [])
        self.look((0.0, 0.0), 0)

    def _begin(self, targets, onsets):
        self._targets, self._due = list(targets), [int(v) for v in onsets]
        self._onsets, self._drawn_us, self._since_us = [], None, None

    def open(self, device):
        """Nothing to learn: onsets are taken from the device time at which a frame was drawn."""

    def reach_deg(self):
        """(azimuth, elevation) that fit on this screen, degrees."""
        return self.display.reach_deg()

    def look(self, target_deg, now_us):
        """Show one target from now on, outside any plan."""
        self._shown = tuple(target_deg)
        self._draw(self.RING_S)

    def start(self, targets_deg, onsets_us, dwell_s):
        """Take the plan; targets appear as `tick` passes their onsets."""
        self._begin([tuple(map(float, t)) for t in targets_deg], onsets_us)

    def tick(self, now_us):
        """Draw what is due at device time now_us, at most at the refresh rate of a display."""
        if self._drawn_us is not None and now_us - self._drawn_us < self.REFRESH_US:
            return
        self._drawn_us = now_us
        events = self._pygame.event.get()
        for event in events:
            if event.type == self._pygame.QUIT or (
                event.type == self._pygame.KEYDOWN and event.key == self._pygame.K_ESCAPE
            ):
                raise KeyboardInterrupt
        appeared = False
        while len(self._onsets) < len(self._due) and now_us >= self._due[len(self._onsets)]:
            self._shown = self._targets[len(self._onsets)]
            self._onsets.append(
                now_us
            )  # late by one refresh at most; the label says when it was really drawn
            self._since_us = now_us
            appeared = True
        age_s = self.RING_S if self._since_us is None else (now_us - self._since_us) * 1e-6
        if appeared or age_s < self.RING_S + 0.05:
            self._draw(age_s)

    def _draw(self, age_s):
        pygame, surface = self._pygame, self._surface
        per_degree = self.display.pixels_per_degree()
        at = tuple(int(round(v)) for v in self.display.to_pixels(self._shown))
        dot = max(2, int(round(self.DOT_DEG / 2 * per_degree)))
        left = max(0.0, 1.0 - age_s / self.RING_S)
        surface.fill(self.GROUND)
        if left > 0.0:
            ring = dot + int(round(self.RING_DEG / 2 * per_degree * left))
            pygame.draw.circle(surface, self.RING, at, ring, max(1, dot // 3))
        pygame.draw.circle(surface, self.INK, at, dot)
        pygame.draw.circle(surface, self.GROUND, at, max(1, dot // 4))
        pygame.display.flip()

    def onsets_us(self):
        """Device times at which the targets were drawn; shorter than the plan when it was cut short."""
        return list(self._onsets)

    def close(self):
        """Give the display back."""
        self._pygame.display.quit()


def screen_for(device, **window):
    """The screen that belongs to an open device: its simulated person's, or a WindowScreen(**window)."""
    control = device.link.control
    return WindowScreen(**window) if control is None else VirtualScreen(control)
