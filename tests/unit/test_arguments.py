# SPDX-License-Identifier: Apache-2.0
"""Arguments that are one of a few names or numbers: another is refused by what it may be, and not sent."""

from types import SimpleNamespace

import pytest

from sparsegaze.device import Device
from sparsegaze.errors import SceneError
from sparsegaze.headset import load_headset
from sparsegaze.image import ImageMethod
from sparsegaze.maps import GazeMap
from sparsegaze.person import load_person
from sparsegaze.scene import Scene
from sparsegaze.sensing import Sensing


class Silent(Sensing):
    """Fails the test when anything is asked of it but what is there."""

    @property
    def _exchange(self):
        stored = SimpleNamespace(curve_q10=(0,) * 6, zero_q2=0)
        return SimpleNamespace(request=lambda kind, body=b"", answer=None: stored)


@pytest.mark.parametrize("arguments, words", [
    ({"wiring": "x"}, "leds, photodiodes, not 'x'"), ({"wiring": 1}, "leds, photodiodes, not 1"),
    ({"wiring": ""}, "leds, photodiodes, not ''"), ({"power": "turbo"}, "normal, low, not 'turbo'"),
    ({"power": ["low"]}, "normal, low"), ({"repeats": 3}, "1, 2, 4, 8, 16, not 3"),
    ({"repeats": 0}, "not 0"), ({"repeats": "4"}, "not '4'"),
    ({"rate_hz": -1}, "0 to 65535"), ({"rate_hz": 65536}, "0 to 65535"),
    ({"rate_hz": float("nan")}, "0 to 65535"), ({"rate_hz": float("inf")}, "0 to 65535")])
def test_settings(arguments, words):
    silent = Silent()
    with pytest.raises(ValueError, match=words):
        silent.settings(**arguments)


@pytest.mark.parametrize("call", [
    lambda silent: silent.probe(6), lambda silent: silent.probe(-1), lambda silent: silent.probe(300),
    lambda silent: silent.exposure(us=[float("inf")] * 6),
    lambda silent: silent.exposure(us=[float("nan")] * 6),
    lambda silent: silent.exposure(limit_us=[-1] * 6), lambda silent: silent.exposure(us=[1] * 5),
    lambda silent: silent.curve([float("inf")] * 6), lambda silent: silent.curve(zero_codes=float("inf")),
    lambda silent: silent.curve([0.2] * 6), lambda silent: silent.curve(zero_codes=1)], ids=range(11))
def test_numbers_of_the_sensors(call):
    with pytest.raises(ValueError):
        call(Silent())


@pytest.mark.parametrize("slot", [3, -1, 300, "A"])
@pytest.mark.parametrize("name", ["verify", "read_model", "read_slot"])
def test_slots(name, slot):
    device = SimpleNamespace(model_info=lambda: SimpleNamespace(active=0))
    with pytest.raises(ValueError, match="a slot is one of 0, 1, 2"):
        getattr(Device, name)(device, slot, *([1] if name == "read_slot" else []))


def test_parts_of_a_scene(repo_root):
    headset = load_headset(str(repo_root / "headsets" / "led2gaze.toml"))
    scene = headset, load_person(str(repo_root / "persons" / "nominal.toml"))
    with pytest.raises(SceneError, match="a term is one of face, sclera, iris, eye, smooth, not 'nose'"):
        Scene(*scene).smooth(0, 0, 3.5, 1.0, "nose")
    with pytest.raises(SceneError, match="a part is one of face, sclera, iris, glint, not 'nose'"):
        ImageMethod(*scene, pixels=8).response(0, 0, parts=("nose",))
    with pytest.raises(SceneError, match="a part is one of face, not 'nose'"):
        GazeMap.sensor_maps(SimpleNamespace(parts={"face": None}), 0, "nose")
