# SPDX-License-Identifier: Apache-2.0
"""Screens: geometry of a real display, a window under SDL's dummy driver, the simulated person's clock."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from fake_device import FakeDevice
from hypothesis import given, strategies as st

from sparsegaze import capture, metrics, targets
from sparsegaze.errors import CalibrationError
from sparsegaze.screen import Display, VirtualScreen, WindowScreen, screen_for


@given(st.floats(-60, 60), st.floats(-60, 60))
def test_a_pixel_is_where_the_gaze_ray_meets_the_screen(azimuth, elevation):
    display = Display((1920, 1080), 520.0, 600.0)
    x, y = display.to_pixels((azimuth, elevation))
    point = np.array([(x - 960) * 520 / 1920, (540 - y) * 520 / 1920, 600.0])
    assert metrics.angle_between_deg(point, metrics.fick_vector(azimuth, elevation)) < 1e-9


def test_pixels_grow_to_the_right_and_down():
    display = Display((1000, 500), 1000.0, 1000.0)
    assert display.to_pixels((0, 0)) == (500, 250)
    assert display.to_pixels((10, 0))[0] == pytest.approx(500 + 1000 * math.tan(math.radians(10)))
    assert display.to_pixels((0, 10))[1] < 250


@pytest.mark.parametrize("distance_mm, width_mm", [(600, 530), (300, 530), (2000, 300)])
def test_every_corner_within_reach_is_on_the_screen(distance_mm, width_mm):
    display = Display((1920, 1080), width_mm, distance_mm)
    azimuth, elevation = display.reach_deg()
    for a in (-azimuth, azimuth):
        for e in (-elevation, elevation):
            x, y = display.to_pixels((a, e))
            assert 0 <= x <= 1920 and 0 <= y <= 1080


@pytest.mark.parametrize("distance_mm, width_mm", [(0, 530), (600, -1), (float("nan"), 530)])
def test_impossible_geometry_is_refused_with_the_options_to_correct(distance_mm, width_mm):
    with pytest.raises(CalibrationError) as caught:
        Display((1920, 1080), width_mm, distance_mm)
    assert "--width-mm" in caught.value.remedy


@pytest.fixture
def window(monkeypatch):
    import pygame  # noqa: F401  (make setup installs it: missing is a failure)

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    shown = WindowScreen(distance_mm=600, width_mm=900, full_screen=False, size=(1280, 960))
    yield shown
    shown.close()


def lit(window, target_deg):
    """Whether the dot's rim is drawn at this target."""
    x, y = window.display.to_pixels(target_deg)
    ring = int(round(0.35 / 2 * window.display.pixels_per_degree())) - 1
    return window._surface.get_at((int(round(x)) + ring, int(round(y))))[:3] == window.INK


def test_a_window_shows_each_target_when_its_time_has_come(window):
    places = [(-15.0, 10.0), (15.0, -10.0), (0.0, 5.0)]
    window.start(places, [1_000_000, 2_000_000, 3_000_000], 1.0)
    assert lit(window, (0.0, 0.0))
    for now in range(900_000, 3_500_000, 3840):
        window.tick(now)
        shown = (now - 1_000_000) // 1_000_000 if now >= 1_020_000 else None
        if shown is not None and now % 1_000_000 > 20_000:
            assert lit(window, places[shown])
            assert sum(lit(window, place) for place in places) == 1
    onsets = np.array(window.onsets_us())
    assert len(onsets) == 3
    late = onsets - [1_000_000, 2_000_000, 3_000_000]
    assert (late >= 0).all() and (late <= window.REFRESH_US + 3840).all()


def test_the_ring_shrinks_onto_the_dot(window):
    window.start([(0.0, 0.0)], [0], 1.0)
    ringed = []
    for now in range(0, 600_000, 20_000):
        window.tick(now)
        pixels = [window._surface.get_at((640 + dx, 480))[:3] for dx in range(0, 60)]
        ringed.append(max([i for i, colour in enumerate(pixels) if colour == window.RING], default=0))
    assert ringed[0] > 10 and ringed[-1] == 0
    assert all(later <= earlier for earlier, later in zip(ringed, ringed[1:]))


def test_a_calibration_runs_in_a_window_and_labels_frames_by_what_was_drawn(window):
    device = FakeDevice()

    class Person(WindowScreen):
        """Follows the dot that is really on the screen."""

        def __init__(self):
            self.__dict__ = window.__dict__

        def tick(self, now_us):
            super().tick(now_us)
            if not device.schedule or device.schedule[-1][1] != self._shown:
                device.schedule.append((now_us, self._shown))

    shown = Person()
    plan = targets.calibration_plan(9, reach_deg=shown.reach_deg())
    taken = capture.run(device, shown, plan)
    assert taken.selection.used_targets == 9
    assert len(taken.run.onset_us) == 9
    for k in range(9):
        rows = (taken.run.target_index == k) & taken.run.settled
        assert (taken.run.target_deg[rows] == plan.target_deg[k]).all()


@pytest.mark.parametrize("what", ["escape", "close"])
def test_escape_and_closing_the_window_interrupt(window, what):
    import pygame

    window.start([(0.0, 0.0)], [0], 1.0)
    window.tick(0)
    pygame.event.post(
        pygame.event.Event(pygame.QUIT)
        if what == "close"
        else pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE)
    )
    with pytest.raises(KeyboardInterrupt):
        window.tick(100_000)


def test_no_display_is_one_line_with_a_remedy(monkeypatch):
    import pygame  # noqa: F401  (make setup installs it: missing is a failure)

    monkeypatch.setenv("SDL_VIDEODRIVER", "no-such-driver")
    with pytest.raises(CalibrationError, match="no screen"):
        WindowScreen()


def test_without_pygame_the_remedy_is_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pygame", None)
    with pytest.raises(CalibrationError) as caught:
        WindowScreen()
    assert "sparsegaze[screen]" in caught.value.remedy


class Control:
    """A virtual Nano's control socket whose clock runs `ahead` us behind device time; a look takes 300 us."""

    def __init__(self, ahead):
        self.us, self.ahead, self.log = 50_000_000.0, ahead, []

    def time(self):
        self.us += 300
        return SimpleNamespace(us=self.us)

    def targets_clear(self):
        self.log.append("clear")

    def target(self, us, azimuth, elevation):
        self.log.append((us, azimuth, elevation))

    def ping(self):
        self.us += 400
        return SimpleNamespace(rx_us=int(self.us + self.ahead) - 200, tx_us=int(self.us + self.ahead) - 150)


def test_the_simulated_persons_targets_are_scheduled_on_the_devices_clock():
    control = Control(ahead=-48_000_000)
    screen = screen_for(SimpleNamespace(link=SimpleNamespace(control=control)))
    assert isinstance(screen, VirtualScreen)
    screen.open(control)
    assert abs(screen.offset_us - -48_000_000) <= 400
    screen.start([(1.0, 2.0), (3.0, -4.0)], [5_000_000, 6_000_000], 1.0)
    assert control.log[0] == "clear"
    assert [entry[1:] for entry in control.log[1:]] == [(1.0, 2.0), (3.0, -4.0)]
    assert all(abs(entry[0] - when) <= 400 for entry, when in zip(control.log[1:], (53_000_000, 54_000_000)))
    assert screen.onsets_us() == [5_000_000, 6_000_000]
