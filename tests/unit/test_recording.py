# SPDX-License-Identifier: Apache-2.0
"""recording.py: round trips, interrupted files, and hostile ones."""

import numpy as np
import pytest

from sparsegaze.errors import RecordingError
from sparsegaze.recording import Recording, RecordingWriter

HEADER = "t_us,s0,s1,target_az_deg,target_el_deg,valid\n"
GOOD = "1000,10,20,1.5,-2.5,1\n"


def recording(n=20, d=6, seed=0):
    rng = np.random.default_rng(seed)
    target = rng.uniform(-22, 22, (n, 2))
    valid = rng.random(n) < 0.7
    target[~valid] = np.nan
    return Recording(
        np.arange(n) * 3600,
        rng.integers(0, 65536, (n, d)),
        np.round(target, 4),
        valid,
        {"headset": "led2gaze", "seed": "7"},
    )


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "r.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


@pytest.mark.parametrize("d", [1, 2, 6])
def test_round_trip_is_exact(tmp_path, d):
    before = recording(d=d)
    before.write(tmp_path / "r.csv")
    after = Recording.read(tmp_path / "r.csv")
    for name in ("t_us", "features", "target_deg", "valid"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    assert after.meta == before.meta
    assert [p.name for p in tmp_path.iterdir()] == ["r.csv"]


def test_rows_that_are_not_valid_may_hold_nan_or_nothing(file):
    r = Recording.read(file(HEADER + GOOD + "2000,nan,,nan,,0\n3000,1,2,inf,nan,0\n"))
    assert r.valid.tolist() == [True, False, False]
    assert np.isnan(r.target_deg[1:]).any(axis=1).all()


def test_columns_in_any_order_unknown_ones_comments_blank_lines_bom_and_crlf(file):
    text = (
        "\ufeff# person: 3\r\n\r\nvalid,note,s1,s0,target_el_deg,target_az_deg,t_us\r\n# hello\r\n"
        "1,x,20,10,-2.5,1.5,1000\r\n"
    )
    r = Recording.read(file(text))
    assert (r.t_us[0], r.features[0].tolist(), r.target_deg[0].tolist()) == (1000, [10, 20], [1.5, -2.5])
    assert r.meta["person"] == "3"


def test_time_may_run_backwards(file):
    assert Recording.read(file(HEADER + GOOD + GOOD.replace("1000", "5"))).t_us.tolist() == [1000, 5]


@pytest.mark.parametrize(
    "text, line, column",
    [
        (HEADER + GOOD + "2,nan,20,1,1,1\n", 3, "s0"),
        (HEADER + GOOD + "2,10,,1,1,1\n", 3, "s1"),
        (HEADER + "2,10,20,nan,1,1\n", 2, "target_az_deg"),
        (HEADER + "2,10,20,1,inf,1\n", 2, "target_el_deg"),
        (HEADER + "2,10,20,1,91,1\n", 2, "target_el_deg"),
        (HEADER + "2,65536,20,1,1,1\n", 2, "s0"),
        (HEADER + "2,-1,20,1,1,1\n", 2, "s0"),
        (HEADER + "2,10.5,20,1,1,1\n", 2, "s0"),
        (HEADER + "2,1e3000,20,1,1,0\n" + "2,70000,20,1,1,0\n", 3, "s0"),
        (HEADER + "x,10,20,1,1,1\n", 2, "t_us"),
        (HEADER + ",10,20,1,1,0\n", 2, "t_us"),
        (HEADER + "2,10,20,1,1,2\n", 2, "valid"),
        (HEADER + "2,10,20,1,1\n", 2, "valid"),
        ("t_us,s0,s1,target_az_deg,valid\n" + GOOD, 1, "target_el_deg"),
        ("t_us,s1,target_az_deg,target_el_deg,valid\n", 1, "s0"),
        ("t_us,target_az_deg,target_el_deg,valid\n", 1, "s0"),
        ("t_us,s0,s0,target_az_deg,target_el_deg,valid\n", 1, "s0"),
        ("t_us,s0,s1,s2,s3,s4,s5,s6,target_az_deg,target_el_deg,valid\n", 1, "7 channels"),
    ],
)
def test_what_is_wrong_is_named_by_file_line_and_column(file, text, line, column):
    path = file(text)
    with pytest.raises(RecordingError) as caught:
        Recording.read(path)
    assert str(path) in caught.value.message and f"line {line}:" in caught.value.message
    assert column in caught.value.message and caught.value.remedy


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"\n\n",
        b"# only: comments\n",
        HEADER.encode(),
        bytes(range(256)) * 20,
        b"\x7fELF" + bytes(100),
        b"t_us," * 5000,
        b"\xff\xfe" + HEADER.encode("utf-16-le"),
        b'{"a": 1}\n',
        HEADER.encode() + b"1,\xff,2,3,4,1\n",
    ],
)
def test_empty_and_binary_files_are_refused_in_one_line(file, text):
    with pytest.raises(RecordingError) as caught:
        Recording.read(file(text))
    assert "\n" not in str(caught.value) and caught.value.remedy and str(caught.value).isprintable()


def test_missing_file_and_folder_are_refused(tmp_path):
    for path in (tmp_path / "no.csv", tmp_path):
        with pytest.raises(RecordingError, match="cannot read"):
            Recording.read(path)
    with pytest.raises(RecordingError, match="cannot write"):
        recording().write(tmp_path / "no" / "r.csv")
    with pytest.raises(RecordingError, match="cannot write"):
        RecordingWriter(tmp_path / "no" / "r.csv", 6)


def test_an_interrupted_recording_is_kept_up_to_its_last_whole_row(tmp_path):
    path, r = tmp_path / "r.csv", recording(100)
    writer = RecordingWriter(path, 6, r.meta, flush_rows=10)
    for i in range(95):
        writer.write(r.t_us[i], r.features[i], r.target_deg[i], r.valid[i])
    kept = Recording.read(path)  # the writer is neither closed nor flushed
    assert 85 <= len(kept) <= 95
    np.testing.assert_array_equal(kept.features, r.features[: len(kept)])
    writer.close()
    assert len(Recording.read(path)) == 95
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    cut = Recording.read(path)
    assert len(cut) == 94 and cut.meta["cut"]


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "r.csv"
    recording(5).write(path)
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(RecordingError, match="No space"):
        recording(50).write(path)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_arrays_that_do_not_fit_together_are_refused():
    with pytest.raises(RecordingError):
        Recording([0, 1], np.zeros((2, 7)), np.zeros((2, 2)), [1, 1])
    with pytest.raises(RecordingError):
        Recording([0, 1], np.zeros((3, 6)), np.zeros((2, 2)), [1, 1])
    with pytest.raises(RecordingError, match="row 1"):
        Recording([0, 1], np.zeros((2, 6)), [[0, 0], [np.nan, 0]], [1, 1])


def test_the_format_is_read_and_an_older_recording_still_is_but_called_outdated(file):
    assert not Recording.read(file(HEADER + GOOD)).outdated     # somebody's own: its scale is theirs
    assert not Recording.read(file("# firmware: 0.2.0\n# recording_format: 2\n" + HEADER + GOOD)).outdated
    for head in ("", "# recording_format: 1\n"):
        read = Recording.read(file("# firmware: 0.1.0\n" + head + HEADER + GOOD))
        assert read.outdated and read.features.tolist() == [[10, 20]]


@pytest.mark.parametrize("text, remedy", [("3", "update this SDK"), ("two", "correct"), ("-1", "correct")])
def test_a_format_of_the_future_or_none_is_refused_by_line(file, text, remedy):
    with pytest.raises(RecordingError, match="line 2: recording_format") as caught:
        Recording.read(file(f"# a: b\n# recording_format: {text}\n" + HEADER + GOOD))
    assert remedy in caught.value.remedy


def test_four_times_the_frames_say_the_same_of_every_fixation():
    from sparsegaze.fixations import fixations

    rng = np.random.default_rng(0)
    places = rng.uniform(-20, 20, (30, 2))
    slope = rng.normal(0, 60, (6, 2))
    found = []
    for period_us in (999, 3996):
        t_us = np.arange(0, 30_000_000, period_us)
        here = places[t_us // 1_000_000]
        signal = 30000 + here @ slope.T + rng.normal(0, 25, (len(t_us), 6))
        found.append(fixations(Recording(t_us, np.round(signal), here, np.ones(len(t_us), bool))))
    fast, slow = found
    assert len(fast.mean) == len(slow.mean) == 30
    np.testing.assert_allclose(fast.noise, slow.noise, rtol=0.05)
    np.testing.assert_allclose(fast.noise_scale(), slow.noise_scale(), rtol=0.1)
    assert np.abs(fast.mean - slow.mean).max() < 10
    assert len(fast.frames(50)) == len(slow.frames(50)) == 1500
