# SPDX-License-Identifier: Apache-2.0
"""Builds `sparsegaze._sim` (cffi, API mode) from sim_c. By hand: python host_sdk/sparsegaze/_sim_build.py

Optional: the SDK streams and calibrates without it; only simulate.py needs it. Wants a C compiler and
Embree 3 (Debian: libembree-dev)."""

import hashlib
import os
import re
import shutil
import sys
import tempfile

from cffi import FFI

HERE = os.path.dirname(os.path.abspath(__file__))
SIM_C = os.path.normpath(os.path.join(HERE, "..", "..", "sim_c"))
HEADERS = ("sim_map.h", "sim_eye.h", "sim_scene.h", "sim_image.h", "sim_osmesa.h")
SOURCES = (
    "sim_map.c",
    "sim_map_file.c",
    "sim_eye.c",
    "sim_lid.c",
    "sim_face.c",
    "sim_skin.c",
    "sim_opening.c",
    "sim_diffuse.c",
    "sim_mirror.c",
    "sim_cover.c",
    "sim_surface.c",
    "sim_sclera.c",
    "sim_cornea.c",
    "sim_edge.c",
    "sim_iris.c",
    "sim_iris_row.c",
    "sim_glint.c",
    "sim_glint_mirror.c",
    "sim_scene.c",
    "sim_image.c",
    "sim_image_eye.c",
    "sim_image_face.c",
    "sim_osmesa.c",
)


def cdef_regions():
    """The text between `// cdef begin` and `// cdef end` of every header: one declaration for both
    languages.
    """
    text = []
    for name in HEADERS:
        with open(os.path.join(SIM_C, name), encoding="utf-8") as file:
            text += re.findall(r"// cdef begin\n(.*?)// cdef end", file.read(), re.S)
    return re.sub(r"//[^\n]*", "", "\n".join(text))


def source_hash():
    """SHA-256 of every source: maps made by another version of the simulator are not found in the cache."""
    digest = hashlib.sha256()
    for name in sorted(os.listdir(SIM_C)):
        if name.endswith((".c", ".h", ".glsl")) and not name.startswith("sim_map"):
            with open(os.path.join(SIM_C, name), "rb") as file:
                digest.update(name.encode() + b"\0" + file.read())
    return digest.hexdigest()


def shader_text():
    """sim_osmesa.glsl as a C string. Its comment comes first, #version must: the comment stays behind."""
    with open(os.path.join(SIM_C, "sim_osmesa.glsl"), encoding="utf-8") as file:
        text = file.read()
    lines = text[text.index("#version") :].splitlines()
    return "\n".join('    "%s\\n"' % line.replace("\\", "\\\\").replace('"', '\\"') for line in lines)


def builder():
    """The configured FFI object."""
    ffi = FFI()
    ffi.cdef(cdef_regions() + "\nextern const char sim_source_hash[];\n")
    ffi.set_source(
        "sparsegaze._sim",
        "\n".join('#include "%s"' % name for name in HEADERS)
        + '\nconst char sim_source_hash[] = "%s";\n' % source_hash()
        + "const char sim_osmesa_shader[] =\n%s;\n" % shader_text(),
        sources=[os.path.join(SIM_C, name) for name in SOURCES],
        include_dirs=[SIM_C],
        libraries=["embree3", "dl", "m"],
        extra_compile_args=["-std=c11", "-O3", "-fno-math-errno", "-fno-trapping-math", "-Wall", "-Wextra"],
    )
    return ffi


def build_in_place(verbose=False):
    """Compile and put the module beside the sources; returns its path. Raises what the compiler's driver
    raises.
    """
    with tempfile.TemporaryDirectory() as scratch:
        made = builder().compile(tmpdir=scratch, verbose=verbose)
        target = os.path.join(HERE, os.path.basename(made))
        shutil.copyfile(made, target + ".new")
        os.replace(target + ".new", target)
    return target


if __name__ == "__main__":
    print(build_in_place("-v" in sys.argv))
