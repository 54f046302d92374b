# SPDX-License-Identifier: Apache-2.0
"""Who sees whom: swapped, dead and covered LEDs by name, past the spread of parts and another face."""

import itertools
import json

import numpy as np
import pytest

from sparsegaze import probe
from sparsegaze.errors import RecordingError
from sparsegaze.wire import lib

SPREAD = 0.3  # octaves rms of each part, as sensor and as emitter: about 20 %


@pytest.fixture(scope="module")
def faces():
    """Matrices of five simulated persons."""
    return [probe.simulated(person=person) for person in range(5)]


def board(face, place=range(6), seed=0, noise=0.01):
    """What a board shows: LEDs of spread parts, pin i wired to the LED in place[i], faint light lost."""
    rng = np.random.default_rng(seed)
    place = np.array(place)
    sensor, emitter = rng.normal(0, SPREAD, (2, 6))
    seen = face[np.ix_(place, place)] + sensor[:, None] + emitter + rng.normal(0, noise, (6, 6)) + 30
    seen[seen < np.nanmedian(seen) - 3.5] = np.nan
    return as_probed(seen)


def as_probed(matrix):
    """Without the three entries that a board cannot measure."""
    return np.where(probe.KNOWN, matrix, np.nan)


def own(face, seed=0):
    """What was kept at calibration of the same board, when all was well."""
    return board(face, seed=seed)


def texts(found):
    return " / ".join(text for text, _ in found.findings)


@pytest.mark.parametrize("person", range(1, 5))
def test_a_good_board_is_good_by_its_own_matrix_and_by_a_simulated_face(faces, person):
    seen = board(faces[person], seed=person)
    assert probe.compare(seen, own(faces[person], person)).findings == []
    found = probe.compare(seen, faces[0], stored=False)
    assert found.findings == [] and found.misfit_octaves < 1.0


@pytest.mark.parametrize("pair", list(itertools.combinations(range(6), 2)), ids=lambda pair: "%d-%d" % pair)
@pytest.mark.parametrize("stored", [True, False], ids=["own matrix", "simulated face"])
def test_every_swap_of_two_is_named(faces, pair, stored):
    place = list(range(6))
    place[pair[0]], place[pair[1]] = place[pair[1]], place[pair[0]]
    for person in range(1, 5):
        # Parts move with their LEDs: the stored matrix is of the same ones in their right places.
        clean = board(faces[person], seed=person, noise=0.0)
        swapped = as_probed(probe._completed(clean)[np.ix_(place, place)])
        found = probe.compare(swapped, clean if stored else faces[0], stored=stored)
        assert found.place == tuple(place), (person, found)
        assert len(found.findings) == 1 and f"LED {pair[0]} and LED {pair[1]}" in texts(found)
        assert f"A{pair[0]} and A{pair[1]}" in found.findings[0][1]


def test_a_ring_of_three_is_named_whole(faces):
    clean = board(faces[1], seed=1)
    place = [2, 1, 4, 3, 0, 5]
    found = probe.compare(as_probed(probe._completed(clean)[np.ix_(place, place)]), clean)
    assert found.place == tuple(place) and "LED 0, LED 2, LED 4" in texts(found)


@pytest.mark.parametrize("led", range(6))
@pytest.mark.parametrize("stored", [True, False], ids=["own matrix", "simulated face"])
def test_dead_led_dead_emitter_and_covered_sensor_are_told_apart(faces, led, stored):
    for person in range(1, 5):
        reference = own(faces[person], person) if stored else faces[0]
        dead, mute, blind = (board(faces[person], seed=person) for _ in range(3))
        dead[led], dead[:, led] = np.nan, np.nan
        mute[:, led] = np.nan
        blind[led] -= 5.0
        said = [texts(probe.compare(seen, reference, stored)) for seen in (dead, mute, blind)]
        assert said == [
            f"LED {led} neither senses nor emits: dead, not connected, or covered",
            f"LED {led} senses, but hardly emits",
            f"LED {led} emits, but hardly senses",
        ]


def test_a_swap_and_a_dead_led_at_once(faces):
    clean = board(faces[2], seed=2)
    place = [0, 1, 3, 2, 4, 5]
    seen = as_probed(probe._completed(clean)[np.ix_(place, place)])
    seen[5], seen[:, 5] = np.nan, np.nan
    found = probe.compare(seen, clean)
    assert "LED 2 and LED 3" in texts(found) and "LED 5 neither" in texts(found) and len(found.findings) == 2


def test_nothing_at_all_is_one_finding():
    found = probe.compare(np.full((6, 6), np.nan), np.zeros((6, 6)))
    assert texts(found) == "no sensor receives anything from any emitter"


def test_a_matrix_comes_back_from_its_file_and_from_a_calibrations_report(tmp_path, faces):
    seen = board(faces[1])
    probe.save(tmp_path / "p.json", seen)
    np.testing.assert_allclose(probe.load(tmp_path / "p.json"), seen, atol=1e-4)
    (tmp_path / "report.json").write_text(json.dumps({"fit": {}, "probe": [[None] * 6] * 6}))
    assert np.isnan(probe.load(tmp_path / "report.json")).all()


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"probe": [[1, 2], [3, 4]]}', '{"probe": "x"}', "\xff\xfe", None]
)
def test_a_file_that_holds_no_matrix_is_refused(tmp_path, text):
    path = tmp_path / "p.json"
    if text is not None:
        path.write_text(text, encoding="latin-1")
    with pytest.raises(RecordingError) as caught:
        probe.load(path)
    assert "report.json" in caught.value.remedy


def plain(matrix):
    return [[None if v != v else float(v) - 20 for v in row] for row in matrix]


def test_the_command_shows_the_matrix_and_names_what_is_wrong(command, command_json, fake, faces, tmp_path):
    clean = board(faces[1], seed=1)
    device = fake(see=plain(clean))
    kept = tmp_path / "kept.json"
    code, data, _ = command_json("probe", "PORT", "--save", kept)
    assert code == 0 and data["ok"] and np.array(data["probe"], float).shape == (6, 6)
    code, out, err = command("probe", "PORT", "--reference", kept)
    assert code == 0 and "all six LEDs are where they belong" in out and "A3 senses" in out
    place = [0, 4, 2, 3, 1, 5]
    device.see = plain(probe._completed(clean)[np.ix_(place, place)])
    code, out, _ = command("probe", "PORT", "--reference", kept)
    assert code == 1 and "LED 1 and LED 4 are in each other's places" in out and "wires at A1 and A4" in out
    code, data, _ = command_json("probe", "PORT")
    assert code == 1 and data["place"] == place


def test_a_part_that_the_board_calls_dead_is_named_by_the_board(command_json, fake, faces):
    seen = as_probed(board(faces[1], seed=1))
    seen[:, 3] = np.nan
    fake(see=plain(seen), fault=(0, 0, 0, lib.SG_FAULT_OPEN, 0, 0))
    code, data, _ = command_json("probe", "PORT")
    assert code == 1 and [row["text"][:16] for row in data["findings"]] == ["sensor 3 is open"]


def test_probe_with_the_lights_off_or_with_photodiodes_says_why_not(command, fake):
    device = fake(alarm=lib.SG_ALARM_LIGHTS_OFF)
    code, _, err = command("probe", "PORT")
    assert code == 1 and "off by command" in err and "--lights on" in err
    device.alarm, device.sensing["wiring"] = 0, lib.SG_WIRING_PHOTODIODES
    code, _, err = command("probe", "PORT")
    assert code == 1 and "photodiodes" in err


def test_probe_with_two_references_is_wrong_usage(command):
    assert command("probe", "PORT", "--reference", "a", "--headset", "b")[0] == 2
