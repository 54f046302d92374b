# SPDX-License-Identifier: Apache-2.0
"""Files of gaze maps: .npz archives of plain arrays and text, written whole or not at all; whatever is read
is taken for hostile.
"""

import json
import os
import tempfile
import zipfile

import numpy as np

from .errors import SceneError
from .headset import lit_of

FORMAT = 1
MOST_BYTES = 4 << 30  # of one array; more is refused unread
_ARRAYS = ("response", "pupil_mm", "lid_opening", "slip_mm", "azimuth_deg", "elevation_deg", "error_estimate")
_NUMBERS = ("mean", "tol", "seconds")
_TEXTS = ("method", "version", "units", "modelled", "not_modelled")
_DATA = ("headset", "person", "estimate_rms", "left_out")  # as JSON
_PARTS = ("face", "sclera", "iris", "glint")


def write_npz(path, made):
    """Write a GazeMap. The file appears under its name when it is complete; before, what was there stays."""
    path = os.fspath(path)
    content = {name: getattr(made, name) for name in _ARRAYS}
    content.update({name: np.float64(getattr(made, name)) for name in _NUMBERS})
    content.update({name: np.array(getattr(made, name)) for name in _TEXTS})
    content.update({name: np.array(json.dumps(getattr(made, name))) for name in _DATA})
    content.update({"part_" + name: values for name, values in made.parts.items()})
    content["format"] = np.int64(FORMAT)
    handle, temporary = tempfile.mkstemp(".npz", ".", os.path.dirname(path) or ".")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **content)
            file.flush()
            os.fsync(file.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def read_map(path):
    """Fields of a GazeMap, from a file. SceneError when it is not one."""
    name = os.path.basename(os.fspath(path))

    def refuse(why):
        raise SceneError("%s: %s" % (name, why), "sparsegaze map writes such files; make it again")

    try:
        found = read_arrays(path)
    except OSError as error:
        raise SceneError("%s: %s" % (path, error.strerror or "cannot be read"), "give the path of a map")
    except Damaged as error:
        refuse("not a map, or damaged (%s)" % error)
    return _fields(found, refuse)


class Damaged(Exception):
    """An archive that is not what its writer wrote."""


def read_arrays(path):
    """{name: array} of an .npz archive of numbers and text. OSError when it cannot be opened, Damaged when
    anything in it is not as it should be; no array is larger than its file says.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
            return {info.filename[:-4]: _member(archive, info) for info in members}
    except (OSError, Damaged):
        raise
    except Exception as error:  # zipfile, zlib, struct, tokenize and numpy each have errors of their own
        raise Damaged("%s: %s" % (type(error).__name__, error))


def _member(archive, info):
    """One array of an archive, after its header was seen to be what its length allows."""
    if info.file_size > MOST_BYTES:
        raise Damaged("%s is too large" % info.filename)
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise Damaged("%s is of an unknown version" % info.filename)
        read = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}[version[0]]
        shape, _, dtype = read(file)
        if dtype.hasobject or dtype.kind not in "fiU":
            raise Damaged("%s holds %s" % (info.filename, dtype))
        expected = dtype.itemsize
        for length in shape:
            expected *= int(length)
        if expected > info.file_size:
            raise Damaged("%s is shorter than it says" % info.filename)
    with archive.open(info) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _fields(found, refuse):
    missing = [n for n in _ARRAYS + _NUMBERS + _TEXTS + _DATA + ("format",) if n not in found]
    if missing:
        refuse("has no " + ", ".join(missing))
    if found["format"].shape != () or found["format"] != FORMAT:
        refuse("its format is %s, this version reads %d" % (found["format"], FORMAT))
    out = {}
    for name in _TEXTS + _DATA:
        if found[name].dtype.kind != "U" or found[name].shape != ():
            refuse("%s is not text" % name)
        out[name] = str(found[name])
    for name in _NUMBERS:
        if found[name].dtype != np.float64 or found[name].shape != () or not np.isfinite(found[name]):
            refuse("%s is not a finite number" % name)
        out[name] = float(found[name])
    for name in _DATA:
        try:
            out[name] = json.loads(out[name])
        except (ValueError, RecursionError):
            refuse("%s is not JSON" % name)
        if not isinstance(out[name], list if name == "left_out" else dict):
            refuse("%s is not of its kind" % name)
    parts = {name: found["part_" + name] for name in _PARTS if "part_" + name in found}
    for name in _ARRAYS:
        out[name] = found[name]
    _check_shapes(out, parts, refuse)
    _check_headset(out["headset"], out["response"].shape[1:3], refuse)
    return dict(out, parts=parts)


def _check_headset(headset, pairs, refuse):
    try:
        lit = lit_of(headset)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        refuse("its headset is not one")
    if lit.shape != pairs:
        refuse("its headset has %d sensors and %d emitters, its response %d and %d" % (lit.shape + pairs))


def _check_shapes(out, parts, refuse):
    response = out["response"]
    if response.ndim != 5 or 0 in response.shape:
        refuse("response has %d axes, wants state, sensor, emitter, elevation, azimuth" % response.ndim)
    states, n, m, rows, columns = response.shape
    wanted = dict(
        response=response.shape,
        pupil_mm=(states,),
        lid_opening=(states,),
        slip_mm=(states, 3),
        azimuth_deg=(columns,),
        elevation_deg=(rows,),
        error_estimate=(states, n, m),
    )
    arrays = dict({name: out[name] for name in wanted}, **{"part_" + name: v for name, v in parts.items()})
    for name, values in arrays.items():
        if values.dtype != np.float64 or values.shape != wanted.get(name, response.shape):
            refuse("%s is %s %s" % (name, values.dtype, values.shape))
        unknown = name == "error_estimate" and out["method"] == "image"
        if not unknown and not np.isfinite(values).all():
            refuse("%s has numbers that are not finite" % name)
    if min(out["error_estimate"].min(initial=0.0), 0.0) < 0:
        refuse("error_estimate is negative")
    for name in ("azimuth_deg", "elevation_deg"):
        if (np.diff(out[name]) <= 0).any():
            refuse("%s does not ascend" % name)
