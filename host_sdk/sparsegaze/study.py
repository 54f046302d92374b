# SPDX-License-Identifier: Apache-2.0
"""Studies: gaze maps of many placements on many people, over any executor, resumable.

    made = sweep(["a.toml", "b.toml"], range(20), directory="study")
    made.response[1, 7]        placement b on person 7: [state, sensor, emitter, elevation, azimuth]

Every (headset, person) is one item: computed by one call in a worker, written by this process into
`directory` under the hash of everything it depends on. A study that was interrupted goes on where it was; one
with more people or placements computes only those.
"""

import concurrent.futures
import functools
import hashlib
import json
import multiprocessing
import os
import queue
import signal
from collections import namedtuple
from dataclasses import dataclass, field

import numpy as np

from . import __version__
from .errors import SceneError, SparsegazeError
from .headset import Headset
from .mapstore import Damaged, read_arrays
from .person import Person
from .scene import simulator
from .simulate import as_headset, as_person

ITEM_VERSION = 1  # changes when the content of item files does
MEMORY_BYTES = 1 << 30  # results above this lie in a file of `directory`, not in memory
_ITEM_ARRAYS = ("response", "error_estimate", "mean")
_STUDY_ARRAYS = (
    "response", "error_estimate", "mean", "headsets", "persons", "sensors", "emitters",
    "pupil_mm", "lid_opening", "slip_mm", "azimuth_deg", "elevation_deg",
)  # fmt: skip

Failure = namedtuple("Failure", "headset person reason remedy")


@dataclass(frozen=True, eq=False)
class Study:
    """Responses of H placements on P people. NaN where an item failed, and beyond the sensors and emitters
    of a headset with fewer than the others.

    response         [H, P, state, sensor, emitter, elevation, azimuth], 1/mm^2
    error_estimate   [H, P, state, sensor, emitter]: a bound on the error of any gaze of that pair
    mean             [H, P]: the response's mean, as maps.GazeMap has it
    headsets, persons          names; sensors, emitters   how many each headset has
    pupil_mm, lid_opening, slip_mm     the states          azimuth_deg, elevation_deg   the gazes
    failures         of the items that could not be made
    computed         how many items were computed now; the others were there already
    """

    response: np.ndarray
    error_estimate: np.ndarray
    mean: np.ndarray
    headsets: np.ndarray
    persons: np.ndarray
    sensors: np.ndarray
    emitters: np.ndarray
    pupil_mm: np.ndarray
    lid_opening: np.ndarray
    slip_mm: np.ndarray
    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    failures: list = field(default_factory=list)
    computed: int = 0

    def save(self, path):
        """Write an .npz file, whole or not at all; numpy.load reads it. OSError when it cannot be written."""
        said = json.dumps({"failures": [list(failure) for failure in self.failures], "version": __version__})
        _write_npz(path, dict({name: getattr(self, name) for name in _STUDY_ARRAYS}, said=np.array(said)))

    @classmethod
    def load(cls, path):
        """Read a file that `save` wrote. SceneError for any other."""
        try:
            file = read_arrays(path)
            arrays = {name: file[name] for name in _STUDY_ARRAYS}
            said = json.loads(str(file["said"]))
            return cls(**arrays, failures=[Failure(*failure) for failure in said["failures"]])
        except (OSError, Damaged, ValueError, KeyError, TypeError, RecursionError) as error:
            raise SceneError("%s is not a study (%s)" % (path, error), "make it with sparsegaze study")


def _write_npz(path, arrays):
    temporary = "%s.%d.tmp" % (os.fspath(path), os.getpid())
    try:
        with open(temporary, "wb") as file:
            np.savez(file, **arrays)
        os.replace(temporary, path)
    except BaseException:
        if os.path.exists(temporary):
            os.unlink(temporary)
        raise


def compute_item(headset, person, options):
    """One item, in a worker: {"response", "error_estimate", "mean", axes ...}, or {"reason", "remedy"} when
    it cannot be made. Never raises for what is the item's own fault.
    """
    from .maps import compute_map

    try:
        made = compute_map(headset, person, workers=1, **options)
    except SparsegazeError as error:
        return {"reason": error.message, "remedy": error.remedy}
    except (ArithmeticError, ValueError, TypeError, MemoryError) as error:
        return {"reason": "%s: %s" % (type(error).__name__, error), "remedy": "report this item"}
    return {name: np.asarray(getattr(made, name)) for name in _ITEM_ARRAYS + _AXES}


_AXES = ("pupil_mm", "lid_opening", "slip_mm", "azimuth_deg", "elevation_deg")


@functools.cache
def _driver_source():
    """Hash of the modules that choose how finely a map is integrated: other choices are other numbers."""
    digest, here = hashlib.sha256(), os.path.dirname(os.path.abspath(__file__))
    for name in ("maps", "mapmake", "mapplan", "mapcall", "mapneed", "mapjudge"):
        with open(os.path.join(here, name + ".py"), "rb") as file:
            digest.update(file.read())
    return digest.hexdigest()


def item_name(headset, person, options):
    """File name of an item: the hash of headset, person, options and the simulator's own source."""
    ffi, lib = simulator()
    text = repr((headset.describe(), person.describe(), sorted(options.items()), ITEM_VERSION, __version__))
    text += ffi.string(lib.sim_source_hash).decode() + _driver_source()
    return hashlib.sha256(text.encode()).hexdigest()[:32] + ".npz"


def sweep(
    headsets,
    persons,
    *,
    directory,
    executor=None,
    workers=None,
    progress=None,
    half_angle_deg=25.0,
    grid=21,
    tol=1e-4,
    pupil_mm=(3.5,),
    lid_opening=(1.0,),
    slip_mm=((0.0, 0.0, 0.0),),
    **options,
):
    """Maps of every headset on every person; returns a Study.

    headsets    Headsets or paths of headset files, or {name: either}
    persons     Persons, seeds or paths of person files, or {name: any of these}
    directory   of the finished items (created); the same directory again continues
    executor    whatever has submit() returning futures: concurrent.futures', Dask's client (or its
                get_executor()), mpi4py's MPIPoolExecutor; it is left running. None = own processes
    workers     of own processes; None = one per core
    progress    called with (items done, items wanted, name of the item)
    the rest    goes to maps.compute_map
    SceneError for a file that cannot be read; an item that cannot be simulated becomes a Failure, the others
    are made. KeyboardInterrupt and a broken executor leave finished items in the directory.
    """
    headsets, persons = _named(headsets, as_headset), _named(persons, as_person)
    if not headsets or not persons:
        raise SceneError("a study of nothing", "give at least one headset and one person")
    options = dict(
        options,
        half_angle_deg=half_angle_deg,
        grid=grid,
        tol=tol,
        pupil_mm=_plain(pupil_mm),
        lid_opening=_plain(lid_opening),
        slip_mm=_plain(slip_mm),
    )
    os.makedirs(directory, exist_ok=True)
    wanted = [
        (h, p, os.path.join(directory, item_name(headset, person, options)))
        for h, (_, headset) in enumerate(headsets)
        for p, (_, person) in enumerate(persons)
    ]
    missing = [item for item in wanted if read_item(item[2]) is None]
    state = {"done": len(wanted) - len(missing)}

    def tell(h, p):
        if progress:
            progress(state["done"], len(wanted), "%s on %s" % (headsets[h][0], persons[p][0]))

    failures = {}

    def finished(item, result):
        h, p, path = item
        if "reason" in result:
            failures[h, p] = Failure(headsets[h][0], persons[p][0], result["reason"], result["remedy"])
        else:
            _write_npz(path, result)
        state["done"] += 1
        tell(h, p)

    if state["done"]:
        tell(*wanted[-1][:2])
    own = executor is None and missing
    if own:
        executor = _own_processes(min(workers or os.cpu_count() or 1, len(missing)))
    elif hasattr(executor, "get_executor"):  # Dask's client: its executor's futures are complete ones
        executor = executor.get_executor()
    try:
        arguments = [(item, (headsets[item[0]][1], persons[item[1]][1], options)) for item in missing]
        _run(executor, arguments, finished)
    finally:
        if own:
            executor.shutdown(wait=True, cancel_futures=True)
    return _collect(headsets, persons, wanted, failures, directory, len(missing) - len(failures))


def _named(things, as_one):
    """[(name, thing)] of a list or a dict of them; names are unique."""
    if isinstance(things, (str, bytes, os.PathLike, Headset, Person, int)):
        things = [things]
    pairs = things.items() if isinstance(things, dict) else ((None, thing) for thing in things)
    named, seen = [], {}
    for name, thing in pairs:
        one = as_one(thing)
        if name is None:
            if isinstance(thing, (str, os.PathLike)):
                name = os.path.splitext(os.path.basename(os.fspath(thing)))[0]
            elif isinstance(one, Headset):
                name = one.name
            else:
                name = "person" if isinstance(thing, Person) else "person %d" % thing
        seen[name] = seen.get(name, 0) + 1
        named.append((str(name) if seen[name] == 1 else "%s #%d" % (name, seen[name]), one))
    return named


def _plain(values):
    """Nested tuples of floats: the same states hash the same, whatever they came in."""
    return tuple(_plain(v) if np.ndim(v) else float(v) for v in (values if np.ndim(values) else [values]))


def _own_processes(workers):
    # Not fork: the parent may have threads, and a child of fork would inherit their locks.
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    return concurrent.futures.ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context(method), initializer=_end_quietly
    )


def _end_quietly():
    """Ctrl-C reaches every process of a terminal's group: a worker just ends, its parent says so."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _run(executor, arguments, finished):
    """Submit compute_item for every (item, arguments); calls finished(item, result) here as they come in.

    Needs of a future only add_done_callback, result and cancel: those of Dask and mpi4py are not
    concurrent.futures' own, and as_completed looks inside.
    """
    waiting, ended = {}, queue.SimpleQueue()
    try:
        for number, (item, values) in enumerate(arguments):
            future = executor.submit(compute_item, *values)
            waiting[number] = item, future
            future.add_done_callback(lambda done, number=number: ended.put(number))
        while waiting:
            item, future = waiting.pop(ended.get())
            try:
                result = future.result()
            except concurrent.futures.BrokenExecutor as error:
                raise SparsegazeError(
                    "a worker ended before its item was done (%s)" % (str(error) or type(error).__name__),
                    "finished items are kept: run it again, with fewer workers if memory was short",
                )
            finished(item, result)
    finally:
        for _, future in waiting.values():
            future.cancel()


def read_item(path):
    """The arrays of an item file, or None when it is not there or damaged."""
    try:
        file = read_arrays(path)
        made = {name: file[name] for name in _ITEM_ARRAYS + _AXES}
    except (OSError, Damaged, KeyError):
        return None
    if any(values.dtype != np.float64 for values in made.values()):
        return None
    shape = made["response"].shape
    whole = len(shape) == 5 and made["error_estimate"].shape == shape[:3] and made["mean"].shape == ()
    whole = whole and shape[3:] == (len(made["elevation_deg"]), len(made["azimuth_deg"]))
    return made if whole and np.isfinite(made["response"]).all() else None


def _collect(headsets, persons, wanted, failures, directory, computed):
    """One array of all items."""
    first = next((made for made in (read_item(path) for _, _, path in wanted) if made), None)
    if first is None:
        reason = next(iter(failures.values()))
        raise SceneError(
            "no item of the study can be simulated; %s on %s: %s" % reason[:3], reason.remedy
        )
    sensors = np.array([len(headset.sensors) for _, headset in headsets])
    emitters = np.array([len(headset.emitters) for _, headset in headsets])
    states, gazes = first["response"].shape[0], first["response"].shape[3:]
    shape = (len(headsets), len(persons), states, sensors.max(), emitters.max()) + gazes
    if 8 * np.prod(shape, dtype=float) > MEMORY_BYTES:
        response = np.lib.format.open_memmap(
            os.path.join(directory, "response.npy"), "w+", dtype=np.float64, shape=shape
        )
        response[:] = np.nan
    else:
        response = np.full(shape, np.nan)
    error, mean = np.full(shape[:5], np.nan), np.full(shape[:2], np.nan)
    for h, p, path in wanted:
        if (h, p) in failures:
            continue
        made = read_item(path)
        if made is None:
            raise SparsegazeError("%s was damaged or removed meanwhile" % path, "run the study again")
        n, m = made["response"].shape[1:3]
        response[h, p, :, :n, :m] = made["response"]
        error[h, p, :, :n, :m], mean[h, p] = made["error_estimate"], made["mean"]
    return Study(
        response=response,
        error_estimate=error,
        mean=mean,
        headsets=np.array([name for name, _ in headsets]),
        persons=np.array([name for name, _ in persons]),
        sensors=sensors,
        emitters=emitters,
        failures=list(failures.values()),
        computed=computed,
        **{name: first[name] for name in _AXES},
    )
