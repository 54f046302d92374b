# SPDX-License-Identifier: Apache-2.0
"""Mitsuba 3 on one triangle mesh: responses of (sensor, emitter) pairs, as the paper's method takes them.

    .venv-bench/bin/python tools/bench/mitsuba_peer.py WORK.npz TASKS.json RESULT.json --variant llvm_ad_mono

Runs in an environment of its own that has Mitsuba and numpy, nothing of this project; bench_peers.py writes
the work and reads the result. Direct light only: what sim_c models, and what costs Mitsuba least.

WORK     vertex [n, 3], normal [n, 3], albedo [n], triangle [m, 3]: the mesh, mm; normals of the true surface
         index, roughness: the mirror's refractive index (k = 0) and Beckmann alpha
         sensor, emitter [jobs, 7]: position, aim (unit vector), tan(sigma) of each job, in the mesh's frame
TASKS    [{part, film, spp, sampler, seeds, jobs, warm}]; part: diffuse, mirror or total
RESULT   {version, variant, threads, tasks: [{..., value [jobs][seeds], seconds [jobs][seeds]}]}
         value: response in 1/mm^2 per unit of axial intensity; seconds: wall, of rendering alone, after a
         first render of the same size that compiles the kernels and is not counted (warm: false: without it)

A sensor is a perspective image of half width REACH tangent sigmas, its pixels weighted by window x cos^3
(their solid angle) and summed. An emitter is a projector whose picture is the beam.
"""

import argparse
import json
import os
import sys
import time

import numpy as np

# Of windows and beams, in sigmas of the tangent: 7e-6 of a Gaussian lies beyond, along an axis.
REACH = 4.5
BEAM_PIXELS = 512  # bilinear between them: (2 REACH / 512)^2 / 12 = 3e-5 of the mean


def main():
    """Render every task. Returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work")
    parser.add_argument("tasks")
    parser.add_argument("result")
    parser.add_argument("--variant", default="llvm_ad_mono")
    options = parser.parse_args()
    import mitsuba

    mitsuba.set_variant(options.variant)
    peer = Peer(mitsuba, np.load(options.work))
    with open(options.tasks, encoding="utf-8") as file:
        tasks = json.load(file)
    began = time.perf_counter()
    for number, task in enumerate(tasks):
        peer.run(task)
        print(
            "mitsuba %s: task %d of %d, %.0f s"
            % (options.variant, number + 1, len(tasks), time.perf_counter() - began),
            file=sys.stderr,
            flush=True,
        )
    with open(options.result, "w", encoding="utf-8") as file:
        json.dump(
            {
                "version": mitsuba.__version__,
                "variant": options.variant,
                "threads": len(os.sched_getaffinity(0)),
                "tasks": tasks,
            },
            file,
        )
    return 0


class Peer:
    """One mesh, many jobs."""

    def __init__(self, mitsuba, work):
        self.mi, self.work = mitsuba, {name: work[name] for name in work.files}
        self.jit = "llvm" in mitsuba.variant() or "cuda" in mitsuba.variant()
        self.shapes, self.scenes = {}, {}

    def run(self, task):
        """Adds value and seconds to a task."""
        task["value"], task["seconds"] = [], []
        for job in task["jobs"]:
            scene, sensor = self.scene(task["part"], job), self.sensor(task, job)
            weight = pixel_weights(task["film"], self.work["sensor"][job][6])
            if task.get("warm", True):
                self.render(scene, sensor, task["spp"], 2**30)
            values, seconds = [], []
            for seed in task["seeds"]:
                began = time.perf_counter()
                image = self.render(scene, sensor, task["spp"], seed)
                values.append(float((weight * image).sum()))
                seconds.append(time.perf_counter() - began)
            task["value"].append(values)
            task["seconds"].append(seconds)

    def render(self, scene, sensor, spp, seed):
        """float64 [row, column]. Evaluated when it returns."""
        image = np.array(self.mi.render(scene, sensor=sensor, spp=spp, seed=seed), dtype=float)
        return image[..., 0] if image.ndim == 3 else image

    def scene(self, part, job):
        """The mesh, lit by the job's emitter. One is built per part and width of beam, then its lamp
        moved.
        """
        at, aim, tangent = split(self.work["emitter"][job])
        key = part, round(tangent, 12)
        if key not in self.scenes:
            self.scenes[key] = self.mi.load_dict(
                {
                    "type": "scene",
                    "integrator": {
                        "type": "direct",
                        "emitter_samples": 1,
                        "bsdf_samples": 0,
                        "hide_emitters": True,
                    },
                    "mesh": self.shape(part),
                    "lamp": {
                        "type": "projector",
                        "to_world": looking(self.mi, at, aim),
                        "fov": float(2 * np.degrees(np.arctan(REACH * tangent))),
                        "scale": float(1 / np.pi),
                        "irradiance": {
                            "type": "bitmap",
                            "bitmap": self.mi.Bitmap(beam_picture(tangent)),
                            "raw": True,
                            "filter_type": "bilinear",
                            "wrap_mode": "clamp",
                        },
                    },
                }
            )
            return self.scenes[key]
        values = self.mi.traverse(self.scenes[key])
        place = looking(self.mi, at, aim)
        values["lamp.to_world"] = self.mi.Transform4f(place) if self.jit else place
        values.update()
        return self.scenes[key]

    def shape(self, part):
        """The mesh with the material of one part; built once."""
        if part not in self.shapes:
            work = self.work
            properties = self.mi.Properties()
            properties["mesh_bsdf"] = self.mi.load_dict(self.material(part))
            mesh = self.mi.Mesh(
                "mesh", len(work["vertex"]), len(work["triangle"]), has_vertex_normals=True, props=properties
            )
            albedo = np.ascontiguousarray(strength(part) * work["albedo"], np.float32)
            mesh.add_attribute("vertex_albedo", 1, albedo if self.jit else albedo.tolist())
            values = self.mi.traverse(mesh)
            values["vertex_positions"] = np.ascontiguousarray(work["vertex"], np.float32).ravel()
            values["vertex_normals"] = np.ascontiguousarray(work["normal"], np.float32).ravel()
            values["faces"] = np.ascontiguousarray(work["triangle"], np.uint32).ravel()
            values.update()
            self.shapes[part] = mesh
        return self.shapes[part]

    def material(self, part):
        """Lambertian by the vertices' albedo, a Beckmann mirror, or both at once."""
        diffuse = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_albedo"}}
        mirror = {
            "type": "roughconductor",
            "distribution": "beckmann",
            "alpha": float(self.work["roughness"]),
            "eta": float(self.work["index"]),
            "k": 0.0,
            "specular_reflectance": strength(part),
        }
        if part == "total":
            return {"type": "blendbsdf", "weight": 0.5, "a": diffuse, "b": mirror}
        return diffuse if part == "diffuse" else mirror

    def sensor(self, task, job):
        """A perspective camera at the job's sensor."""
        at, aim, tangent = split(self.work["sensor"][job])
        return self.mi.load_dict(
            {
                "type": "perspective",
                "to_world": looking(self.mi, at, aim),
                "near_clip": 0.5,
                "far_clip": 1e4,
                "fov": float(2 * np.degrees(np.arctan(REACH * tangent))),
                "fov_axis": "x",
                "film": {
                    "type": "hdrfilm",
                    "width": task["film"],
                    "height": task["film"],
                    "pixel_format": "luminance",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": task.get("sampler", "independent"), "sample_count": task["spp"]},
            }
        )


def looking(mitsuba, at, aim):
    """Transform of something at a place that looks along a unit vector; its roll is immaterial."""
    up = [0, 1, 0] if abs(aim[1]) < 0.9 else [1, 0, 0]
    return mitsuba.ScalarTransform4f().look_at([float(v) for v in at], [float(v) for v in at + aim], up)


def strength(part):
    """Of each material: both together are a half-and-half blend of two of twice the strength."""
    return 2.0 if part == "total" else 1.0


def split(port):
    """position, aim, tan(sigma) of a row."""
    return port[:3], port[3:6], float(port[6])


def pixel_weights(pixels, tangent):
    """window x solid angle of every pixel: mean of window x cos^3 over 3 x 3 Gauss nodes of it, times its
    area.
    """
    nodes, weights = np.polynomial.legendre.leggauss(3)
    half = REACH * tangent
    step = 2 * half / pixels
    centre = (np.arange(pixels) + 0.5) * step - half
    total = np.zeros((pixels, pixels))
    for i, wi in zip(nodes, weights):
        for j, wj in zip(nodes, weights):
            square = (centre[:, None] + i * step / 2) ** 2 + (centre[None] + j * step / 2) ** 2
            total += wi * wj / 4 * np.exp(-square / (2 * tangent**2)) * (1 + square) ** -1.5
    return total * step * step


def beam_picture(tangent):
    """Irradiance on the plane at distance 1 of a beam of unit axial intensity: window x cos^3."""
    t = ((np.arange(BEAM_PIXELS) + 0.5) / BEAM_PIXELS * 2 - 1) * REACH * tangent
    square = t[:, None] ** 2 + t[None] ** 2
    return (np.exp(-square / (2 * tangent**2)) * (1 + square) ** -1.5).astype(np.float32)[..., None]


if __name__ == "__main__":
    sys.exit(main())
