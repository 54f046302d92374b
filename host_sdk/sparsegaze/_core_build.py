# SPDX-License-Identifier: Apache-2.0
"""Build ``sparsegaze._core``: the firmware's own core, called from Python through cffi (API mode).

The declarations are cut out of the C headers between the marks ``// cdef begin`` and ``// cdef end``; there
is no second description of any byte. By hand, from anywhere::

    python host_sdk/sparsegaze/_core_build.py

puts the extension beside this file. setuptools finds the same builder as ``_core_build.py:ffibuilder``.
"""
import os
import re
import shutil
import sys
import tempfile

from cffi import FFI

HERE = os.path.dirname(os.path.abspath(__file__))
CORE = os.path.normpath(os.path.join(HERE, "..", "..", "firmware", "core"))
HEADERS = ("sg_err.h", "sg_wire.h", "sg_model.h", "sg_gp.h", "sg_mlp.h", "sg_reading.h", "sg_light.h",
           "sg_expose.h", "sg_health.h", "sg_link.h", "sg_track.h")
SOURCES = ("sg_wire.c", "sg_model.c", "sg_gp.c", "sg_gp_loop.c", "sg_gp_table.c",
           "sg_mlp.c", "sg_mlp_loop.c", "sg_mlp_table.c", "sg_light.c", "sg_light_loop.c",
           "sg_light_table.c", "sg_expose.c", "sg_health.c",
           "sg_link.c", "sg_track.c")
BATCH = "_core_batch.c"
RATE = os.path.normpath(os.path.join(CORE, "..", "app", "app_rate.c"))    # its enums: what a frame costs
REGION = re.compile(r"^// cdef begin\n(.*?)^// cdef end$", re.MULTILINE | re.DOTALL)


def cdef_regions(path):
    """The marked regions of one C file, in order. ValueError if there is none."""
    with open(path, encoding="utf-8") as file:
        regions = REGION.findall(file.read())
    if not regions:
        raise ValueError(f"{path} has no region between '// cdef begin' and '// cdef end'")
    return regions


def make_ffi(core=CORE, root=None):
    """A configured FFI.

    core: directory of the firmware core (a test builds from an altered copy). root: directory that source
    paths are made relative to, as setuptools wants them; None leaves them absolute."""
    def place(path):
        return path if root is None else os.path.relpath(path, root)

    ffi = FFI()
    batch = os.path.join(HERE, BATCH)
    declared = []
    for path in [os.path.join(core, header) for header in HEADERS] + [batch, RATE]:
        declared.extend(cdef_regions(path))
    ffi.cdef("\n".join(declared))
    # These two files have no header: what they declare comes from their own marked regions.
    prelude = "".join(f'#include "{header}"\n' for header in HEADERS)
    prelude += "".join(cdef_regions(batch) + cdef_regions(RATE))
    ffi.set_source(
        "sparsegaze._core", prelude,
        sources=[place(os.path.join(core, source)) for source in SOURCES] + [place(batch)],
        include_dirs=[place(core)],
        extra_compile_args=[] if sys.platform == "win32" else ["-std=c11", "-O2"],
    )
    return ffi


def build(package_dir=HERE, core=CORE):
    """Compile in a temporary directory and move the extension into package_dir; returns its path.

    The move is atomic, so a process that imports meanwhile gets the old or the new one."""
    work = tempfile.mkdtemp(prefix="sparsegaze-core-")
    try:
        made = make_ffi(core).compile(tmpdir=work)
        target = os.path.join(package_dir, os.path.basename(made))
        fresh = f"{target}.{os.getpid()}.tmp"
        shutil.copyfile(made, fresh)
        shutil.copymode(made, fresh)
        os.replace(fresh, target)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return target


if __name__ == "__main__":
    print(build())
else:
    ffibuilder = make_ffi(root=os.getcwd())
