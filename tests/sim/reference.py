# SPDX-License-Identifier: Apache-2.0
"""The simulator's judge: every term of a response by adaptive cubature of the model as it is written, in
code, parametrisation and quadrature that share nothing with sim_c. See reference.c. Needs only a C compiler.
"""

import hashlib
import importlib.util
import os
import tempfile
from pathlib import Path

import numpy as np
from cffi import FFI

HERE = Path(__file__).resolve().parent
BUILT = HERE.parent.parent / "build" / "reference"
SOURCES = tuple(
    "reference%s.c" % part for part in ("", "_cubature", "_world", "_surfaces", "_iris", "_glint")
)
TERMS = ("face", "sclera", "iris", "glint")

PERSON = (
    "cornea_radius_mm cornea_asphericity limbus_radius_mm limbus_blend_mm limbus_haze_mm globe_radius_mm"
    " iris_depth_mm kappa_azimuth_deg kappa_elevation_deg refractive_index roughness albedo_sclera"
    " albedo_iris albedo_skin lid_upper_deg lid_lower_deg canthus_deg canthus_tilt_deg lid_upper_follow"
    " lid_lower_follow lid_close_at lid_thickness_mm lid_softness_mm lid_radius_mm brow_mm"
    " nose_mm cheek_mm lash_length_mm lash_opacity"
).split()
DECLARED = "struct ref_person { double %s; };" % ", ".join(PERSON) + """
struct ref_port { double position[3], aim[3], sigma_deg, radius_mm; };
int ref_evaluate(const struct ref_person *person, const struct ref_port *sensors, int n_sensors,
                 const struct ref_port *emitters, int n_emitters, const int *pairs, const int *counts,
                 int n_pairs, const double *states, int n_states, int terms, double tol, double scale,
                 double *value, double *error, long *points);
double ref_face_mm(const struct ref_person *person, double x, double y);
double ref_iris_light(const struct ref_person *person, const double *site, const double *spot, double *exit);
"""
_loaded = None


def _library():
    """The compiled reference (ffi, lib), made when its sources changed."""
    global _loaded
    if _loaded:
        return _loaded
    text = "".join((HERE / name).read_text(encoding="utf-8") for name in SOURCES) + DECLARED
    name = "_reference_%s" % hashlib.sha256(text.encode()).hexdigest()[:16]
    found = sorted(BUILT.glob(name + "*.so"))
    if not found:
        BUILT.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            (Path(scratch) / "reference_declared.h").write_text(DECLARED, encoding="utf-8")
            ffi = FFI()
            ffi.cdef(DECLARED)
            ffi.set_source(
                name,
                '#include "reference.c"',
                include_dirs=[scratch, str(HERE)],
                libraries=["m"],
                extra_compile_args=["-std=c11", "-O3", "-fno-math-errno", "-Wall", "-Wextra"],
            )
            made = Path(ffi.compile(tmpdir=scratch))
            os.replace(_moved(made), BUILT / made.name)
            found = [BUILT / made.name]
    spec = importlib.util.spec_from_file_location(name, found[0])
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    _loaded = module.ffi, module.lib
    return _loaded


def _moved(made):
    """The same file beside its destination, so that renaming it there is atomic."""
    beside = BUILT / ("%s.%d" % (made.name, os.getpid()))
    beside.write_bytes(made.read_bytes())
    return beside


def _c_person(ffi, person):
    made = ffi.new("struct ref_person *")
    for name in PERSON:
        setattr(made, name, getattr(person, name, 0.0))
    return made


def face_mm(person, x_mm, y_mm):
    """Height of face and closed lids over the frontal plane through the centre of rotation."""
    ffi, lib = _library()
    return lib.ref_face_mm(_c_person(ffi, person), x_mm, y_mm)


def iris_light(person, site_mm, spot_mm):
    """(irradiance of a spot (x, y) of the iris per intensity at a site, 1/mm^2; where the light crosses the
    cornea), eye frame, along the shortest path; 0 when there is none.
    """
    ffi, lib = _library()
    exit_mm = ffi.new("double[3]")
    spot, site = ffi.new("double[2]", list(spot_mm)), ffi.new("double[3]", list(site_mm))
    return lib.ref_iris_light(_c_person(ffi, person), site, spot, exit_mm), tuple(exit_mm)


def all_pairs(headset):
    """Every (sensor, emitter), in the order of a flattened [sensor, emitter] array."""
    return [(s, e) for s in range(len(headset.sensors)) for e in range(len(headset.emitters))]


def other_pairs(headset):
    """The pairs of two different places; all when the headset has no others."""
    apart = [
        (s, e)
        for s, e in all_pairs(headset)
        if headset.sensors[s].position_mm != headset.emitters[e].position_mm
    ]
    return apart or all_pairs(headset)


def reference_states(
    headset, person, states, pairs=None, tol=3e-6, terms=TERMS, scale=None, slip_mm=(0, 0, 0), all_paths=False
):
    """Every term at several states of one scene, which share the face's work.

    states   [(azimuth_deg, elevation_deg, pupil_mm, lid_opening)], at most 16
    pairs    [(sensor, emitter)], default all
    tol      goal of each term's own error estimate, of the mean total over the pairs of two different places
             at that state (or of `scale`, an absolute response)
    all_paths  also the longer path of two between a very oblique port and the iris, at the end that folds
    Returns ({term: array [state, pair]}, {term: error estimates alike}, {term: integrand evaluations}).
    """
    ffi, lib = _library()
    pairs = all_pairs(headset) if pairs is None else list(pairs)
    apart = set(other_pairs(headset))
    counts = [int(p in apart) for p in pairs]
    if not any(counts):
        counts = [1] * len(pairs)
    ports = []
    for group in (headset.sensors, headset.emitters):
        c = ffi.new("struct ref_port[]", len(group))
        for to, port in zip(c, group):
            to.position = [p + s - e for p, s, e in zip(port.position_mm, slip_mm, person.eye_position_mm)]
            to.aim = list(np.asarray(port.aim) / np.linalg.norm(port.aim))
            to.sigma_deg, to.radius_mm = port.sigma_deg, port.lens_radius_mm
        ports += [c, len(group)]
    flat = [float(v) for state in states for v in state]
    shape = (len(states), 4, len(pairs))
    value, error, points = np.empty(shape), np.empty(shape), ffi.new("long[4]")
    bad = lib.ref_evaluate(
        _c_person(ffi, person),
        *ports,
        ffi.new("int[]", [v for p in pairs for v in p]),
        ffi.new("int[]", counts),
        len(pairs),
        ffi.new("double[]", flat),
        len(states),
        sum(1 << TERMS.index(term) for term in terms) + (16 if all_paths else 0),
        tol,
        scale or 0.0,
        ffi.from_buffer("double[]", value),
        ffi.from_buffer("double[]", error),
        points,
    )
    if bad:
        raise RuntimeError("the reference has no answer for %s" % headset.name)
    return (
        {t: value[:, k] for k, t in enumerate(TERMS) if t in terms},
        {t: error[:, k] for k, t in enumerate(TERMS) if t in terms},
        {t: points[k] for k, t in enumerate(TERMS) if t in terms},
    )


def reference_response(
    headset, person, azimuth_deg, elevation_deg, pupil_mm, lid_opening, pairs=None, tol=3e-6, **more
):
    """({term: array [pairs]}, {term: its error estimate [pairs]}) at one state; see reference_states()."""
    state = (azimuth_deg, elevation_deg, pupil_mm, lid_opening)
    value, error, _ = reference_states(headset, person, [state], pairs, tol, **more)
    return {t: v[0] for t, v in value.items()}, {t: v[0] for t, v in error.items()}
