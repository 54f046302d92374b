# SPDX-License-Identifier: Apache-2.0
"""Studies: the same results over every executor, resumed after a kill, and one bad item among good ones."""

import io
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from sim_scenes import pair, port

from sparsegaze import study
from sparsegaze.cli import run
from sparsegaze.errors import SceneError, SparsegazeError
from sparsegaze.study import Study, read_item, sweep

# Small images of few gazes: what is computed is not the point here, but it is the product's own computation.
QUICK = dict(grid=2, half_angle_deg=8.0, method="image", pixels=8)


@pytest.fixture(scope="module")
def headsets():
    return {
        "low": pair(port((-10, -12, -28)), port((10, -12, -28))),
        "side": pair(port((-16, -4, -28)), port((16, -4, -28))),
    }


@pytest.fixture(scope="module")
def expected(headsets, tmp_path_factory):
    """The study made in this process, one item after the other."""
    return sweep(headsets, [3, 8], directory=tmp_path_factory.mktemp("plain"), executor=Inline(), **QUICK)


class Inline:
    """The least that sweep may ask of an executor: submit, and futures that call back."""

    def submit(self, function, *arguments):
        future = Future()
        future.set_result(function(*arguments))
        return future


def same(one, other):
    np.testing.assert_array_equal(one.response, other.response)
    np.testing.assert_array_equal(one.mean, other.mean)
    assert one.headsets.tolist() == other.headsets.tolist() and one.persons.tolist() == other.persons.tolist()


def test_the_array_is_headset_person_state_sensor_emitter_elevation_azimuth(headsets, expected):
    from sparsegaze.maps import compute_map

    assert expected.response.shape == (2, 2, 1, 1, 1, 2, 2) and np.isfinite(expected.response).all()
    assert expected.headsets.tolist() == ["low", "side"]
    assert expected.persons.tolist() == ["person 3", "person 8"]
    assert expected.azimuth_deg.tolist() == [-8, 8] and expected.computed == 4 and not expected.failures
    made = compute_map(headsets["side"], 3, **QUICK)
    np.testing.assert_array_equal(expected.response[1, 0], made.response)


def test_own_processes(headsets, expected, tmp_path):
    seen = []
    made = sweep(
        headsets, [3, 8], directory=tmp_path, workers=2, progress=lambda *args: seen.append(args), **QUICK
    )
    same(made, expected)
    assert [done for done, _, _ in seen] == [1, 2, 3, 4] and {total for _, total, _ in seen} == {4}
    assert {name for _, _, name in seen} == {f"{h} on person {p}" for h in ("low", "side") for p in (3, 8)}


def test_a_thread_pool_that_stays_open(headsets, expected, tmp_path):
    with ThreadPoolExecutor(2) as pool:
        same(sweep(headsets, [3, 8], directory=tmp_path, executor=pool, **QUICK), expected)
        assert pool.submit(int, "5").result() == 5


@pytest.mark.parametrize("processes", [False, True])
def test_a_local_dask_cluster_by_client_and_by_executor(headsets, expected, tmp_path, processes):
    import distributed  # a dependency of the tests: missing, this fails

    with distributed.LocalCluster(
        n_workers=1 + processes, threads_per_worker=1, processes=processes, dashboard_address=None,
        host="127.0.0.1", protocol="tcp", silence_logs=50,
    ) as cluster, distributed.Client(cluster) as client:  # fmt: skip
        same(sweep(headsets, [3, 8], directory=tmp_path / "client", executor=client, **QUICK), expected)
        executor = client.get_executor()
        same(sweep(headsets, [3, 8], directory=tmp_path / "executor", executor=executor, **QUICK), expected)
        bad = dict(headsets, inside=pair(port((0, 0, 0)), port((10, -12, -28))))
        made = sweep(bad, [3], directory=tmp_path / "client", executor=client, **QUICK)
        assert [failure.headset for failure in made.failures] == ["inside"] and made.computed == 0


class Bare:
    """A future with no more than sweep may use of it: neither Dask's nor mpi4py's is concurrent.futures'."""

    def __init__(self, value):
        self._value = value

    def add_done_callback(self, call):
        call(self)

    def result(self):
        return self._value

    def cancel(self):
        return False


def test_futures_need_not_be_those_of_concurrent_futures(headsets, expected, tmp_path):
    class Executor:
        def submit(self, function, *arguments):
            return Bare(function(*arguments))

    same(sweep(headsets, [3, 8], directory=tmp_path, executor=Executor(), **QUICK), expected)


def test_a_second_run_computes_nothing_and_more_people_only_the_new_ones(headsets, tmp_path):
    first = sweep(headsets, [3], directory=tmp_path, executor=Inline(), **QUICK)
    again = sweep(headsets, [3], directory=tmp_path, executor=None, **QUICK)
    more = sweep(headsets, [8, 3], directory=tmp_path, executor=Inline(), **QUICK)
    other = sweep(headsets, [3], directory=tmp_path, executor=Inline(), **dict(QUICK, pixels=9))
    assert [made.computed for made in (first, again, more, other)] == [2, 0, 2, 2]
    same(first, again)
    np.testing.assert_array_equal(more.response[:, 1], first.response[:, 0])


def with_header(text):
    """An archive with one array whose header is the given text."""
    header = text.encode().ljust(118) + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(8)
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        archive.writestr("response.npy", member)
    return held.getvalue()


HEADERS = {
    "bracket": "{'descr': '<f8', 'fortran_order': False, 'shape': ((1,), }",
    "huge": "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999,), }",
}


@pytest.mark.parametrize("damage", ["cut", "bit", "empty", "pickle", "other", *HEADERS])
def test_a_damaged_item_is_made_again(headsets, expected, tmp_path, damage):
    sweep(headsets, [3, 8], directory=tmp_path, executor=Inline(), **QUICK)
    path = sorted(tmp_path.iterdir())[1]
    data = bytearray(path.read_bytes())
    if damage == "bit":
        data[data.index(b"NUMPY") + 200] ^= 8
    elif damage == "pickle":
        np.savez(path, response=np.array([{}], dtype=object), allow_pickle=True)
        data = path.read_bytes()
    elif damage == "other":
        np.savez(path, response=np.zeros(3))
        data = path.read_bytes()
    elif damage in HEADERS:
        data = with_header(HEADERS[damage])
    path.write_bytes({"cut": data[: len(data) // 2], "empty": b""}.get(damage, bytes(data)))
    assert read_item(path) is None
    made = sweep(headsets, [3, 8], directory=tmp_path, executor=Inline(), **QUICK)
    assert made.computed == 1
    same(made, expected)


SCRIPT = """
import sys
sys.path.insert(0, {tests!r})
from test_study import QUICK, pair, port
from sparsegaze.study import sweep
if __name__ == "__main__":
    low = pair(port((-10, -12, -28)), port((10, -12, -28)))
    tell = lambda done, total, name: print(done, flush=True)
    sweep([low], range(40), directory={folder!r}, workers=1, progress=tell, **QUICK)
"""


def test_after_a_kill_only_what_was_not_finished_is_computed(headsets, tmp_path):
    folder = tmp_path / "items"
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(tests=os.path.dirname(__file__), folder=str(folder)))
    run_it = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        for line in run_it.stdout:
            if int(line) >= 3:
                break
    finally:
        os.killpg(run_it.pid, signal.SIGKILL)
        run_it.wait(20)
        run_it.stdout.close()
    there = [path for path in folder.iterdir() if path.suffix == ".npz" and read_item(path)]
    assert 3 <= len(there) < 40
    stamps = {path: path.stat().st_mtime_ns for path in there}
    made = sweep([headsets["low"]], range(len(there) + 2), directory=folder, executor=Inline(), **QUICK)
    # One worker takes people in order: the first ones are there.
    assert made.computed == 2 and all(path.stat().st_mtime_ns == stamps[path] for path in there)


def test_ctrl_c_ends_the_command_and_the_same_command_goes_on(headset_path, tmp_path):
    command = [sys.executable, "-m", "sparsegaze.cli", "study", headset_path, "--persons", "0-2"]
    command += ["--grid", "1", "--tol", "0.1", "--workers", "1"]
    command += ["-o", str(tmp_path / "s.npz"), "--directory", str(tmp_path / "d")]
    first = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        end = time.monotonic() + 120
        while not list(tmp_path.glob("d/*.npz")) and time.monotonic() < end:
            time.sleep(0.05)
        os.killpg(first.pid, signal.SIGINT)
        said = first.communicate(timeout=60)[1]
    finally:
        if first.poll() is None:
            os.killpg(first.pid, signal.SIGKILL)
            first.communicate()
    assert first.returncode == 130 and "Traceback" not in said and not (tmp_path / "s.npz").exists()
    done = len(list(tmp_path.glob("d/*.npz")))
    assert done >= 1
    again = subprocess.run(command + ["--json"], capture_output=True, text=True, timeout=150, check=True)
    result = json.loads(again.stdout)
    assert result["computed"] == 3 - done and result["items"] == 3
    made = Study.load(tmp_path / "s.npz")
    assert np.isfinite(made.response).all() and (made.error_estimate >= 0).all()


def test_an_impossible_placement_is_named_and_loses_nothing_else(headsets, expected, tmp_path):
    inside = replace(headsets["low"], name="inside", sensors=(port((0.0, 0.0, 0.0)),))
    made = sweep(dict(headsets, inside=inside), [3, 8], directory=tmp_path, executor=Inline(), **QUICK)
    np.testing.assert_array_equal(made.response[:2], expected.response)
    assert np.isnan(made.response[2]).all() and np.isnan(made.mean[2]).all()
    assert [(f.headset, f.person) for f in made.failures] == [("inside", "person 3"), ("inside", "person 8")]
    assert "inside the eyeball" in made.failures[0].reason and made.failures[0].remedy
    made.save(tmp_path / "s.npz")
    read = Study.load(tmp_path / "s.npz")
    np.testing.assert_array_equal(read.response, made.response)
    assert read.failures == made.failures and read.persons.tolist() == ["person 3", "person 8"]


def test_a_study_of_impossible_placements_only_says_why(tmp_path):
    with pytest.raises(SceneError, match="inside the eyeball"):
        sweep([pair(port((0, 0, 0)), port((9, 9, -28)))], [1], directory=tmp_path, executor=Inline(), **QUICK)
    with pytest.raises(SceneError):
        sweep([], [1], directory=tmp_path)


def test_headsets_of_different_sizes_share_one_array(headsets, tmp_path):
    sensor = headsets["low"].sensors[0]
    three = replace(headsets["low"], name="three", sensors=(sensor, port((0, -14, -28)), sensor))
    made = sweep([headsets["low"], three, three], [3], directory=tmp_path, executor=Inline(), **QUICK)
    assert made.response.shape[3:5] == (3, 1) and made.sensors.tolist() == [1, 3, 3]
    assert np.isfinite(made.response[0, 0, 0, :1]).all() and np.isnan(made.response[0, 0, 0, 1:]).all()
    assert made.headsets.tolist() == ["pair", "three", "three #2"] and np.isfinite(made.response[1:]).all()


def test_large_results_lie_in_a_file(headsets, expected, tmp_path, monkeypatch):
    monkeypatch.setattr(study, "MEMORY_BYTES", 64)
    made = sweep(headsets, [3, 8], directory=tmp_path, executor=Inline(), **QUICK)
    assert isinstance(made.response, np.memmap) and (tmp_path / "response.npy").exists()
    same(made, expected)
    made.save(tmp_path / "s.npz")
    same(Study.load(tmp_path / "s.npz"), expected)


def die(*_):
    os._exit(3)


def test_a_worker_that_dies_is_reported_and_finished_items_stay(headsets, tmp_path, monkeypatch):
    sweep([headsets["low"]], [3], directory=tmp_path, executor=Inline(), **QUICK)
    monkeypatch.setattr(study, "compute_item", die)
    with pytest.raises(SparsegazeError, match="worker"):
        sweep(headsets, [3], directory=tmp_path, workers=1, **QUICK)
    assert len([path for path in tmp_path.iterdir() if read_item(path)]) == 1


def test_files_that_are_no_study_are_refused(tmp_path):
    for content in (b"", b"PK\x03\x04 and rubbish", b"plain", *map(with_header, HEADERS.values())):
        (tmp_path / "x.npz").write_bytes(content)
        with pytest.raises(SceneError):
            Study.load(tmp_path / "x.npz")
    with pytest.raises(SceneError):
        Study.load(tmp_path / "none.npz")


@pytest.mark.parametrize("persons", ["", "x", "5-2", "1,,2", "0-999999999", "-3"])
def test_the_command_refuses_people_that_are_none(persons, headset_path, tmp_path, capsys):
    assert run(["study", headset_path, "--persons", persons, "-o", str(tmp_path / "s.npz")]) == 2
    assert not list(tmp_path.iterdir())
    assert "Traceback" not in capsys.readouterr().err


def test_the_command_refuses_files_and_folders_that_are_not_there(headset_path, tmp_path, capsys):
    assert run(["study", str(tmp_path / "no.toml"), "-o", str(tmp_path / "s.npz")]) == 1
    assert run(["study", headset_path, "-o", str(tmp_path / "no" / "s.npz")]) == 1
    said = capsys.readouterr().err
    assert "no.toml" in said and "Traceback" not in said
