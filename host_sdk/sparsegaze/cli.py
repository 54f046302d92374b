# SPDX-License-Identifier: Apache-2.0
"""The `sparsegaze` command. Commands live in cli_*.py, each by the table below.

Exit codes: 0 done; 1 failed (one line on stderr: what is wrong, and the remedy); 2 wrong usage; 130
interrupted by Ctrl-C, 143 by SIGTERM. No traceback reaches the user; SPARSEGAZE_DEBUG=1 lets it through.
"""

import importlib
import json
import os
import signal
import sys
import warnings

import click

from . import __version__
from .errors import SparsegazeError

# title: {name: (module, what it does in one line)}, in the order in which one uses them
GROUPS = {
    "To begin with": {
        "doctor": ("cli_device", "What is installed; what is wrong with a board or a headset."),
        "list": ("cli_device", "Ports and devices, virtual ones too."),
        "virtual": ("cli_device", "Run a virtual Nano: prints its port, runs until stopped."),
        "flash": ("cli_device", "Put the firmware on a board and read it back."),
    },
    "A board and its front end": {
        "info": ("cli_device", "Versions, limits, counters, exposures and stored models."),
        "status": ("cli_health", "Is the board well: faults by name, with what to do."),
        "settings": ("cli_sense", "Frame rate, averaging, power, wiring, lights."),
        "exposure": ("cli_sense", "The six exposure times: automatic, held, set, limited."),
        "linearity": ("cli_health", "Self-calibration of the sensors' linearity."),
        "probe": ("cli_health", "Who sees whom: names swapped, dead and covered LEDs."),
    },
    "Calibration": {
        "calibrate": ("cli_gaze", "Targets, recording, fit, upload and validation in one go."),
        "record": ("cli_gaze", "Record raw features while targets are shown."),
        "fit": ("cli_gaze", "Make a model from a recording (no device needed)."),
        "predict": ("cli_predict", "A model's answers from a target's own binary, with its cycles."),
        "upload": ("cli_device", "Put a model into the device, safe against power cuts."),
        "validate": ("cli_gaze", "Measure the device's gaze on held-out targets."),
        "recentre": ("cli_recentre", "Put a shifted headset right with one look at the centre, or a few."),
    },
    "Gaze": {
        "stream": ("cli_stream", "The gaze computed on the device, live."),
        "replay": ("cli_stream", "The device's arithmetic on the host, over a recording, to the bit."),
    },
    "Simulated optics": {
        "map": ("cli_map", "What each sensor receives over gaze, on a simulated person."),
        "view": ("cli_view", "What one sensor sees of a simulated eye, as a picture."),
        "study": ("cli_study", "Maps of many placements on many people, resumable."),
    },
}
COMMANDS = {name: about for group in GROUPS.values() for name, about in group.items()}


class Commands(click.Group):
    """A group that knows its commands by name and loads one when it is called, so that --help is instant."""

    def list_commands(self, ctx):
        return list(COMMANDS)

    def get_command(self, ctx, name):
        if name not in COMMANDS:
            return None
        module = importlib.import_module("." + COMMANDS[name][0], __package__)
        return module.COMMANDS[name]

    def resolve_command(self, ctx, args):
        name = args[0] if args else ""
        if name not in COMMANDS and not name.startswith("-"):
            import difflib

            near = difflib.get_close_matches(name, COMMANDS, 1)
            ctx.fail(f"no command {name!r}" + (f", did you mean {near[0]}?" if near else ""))
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx, formatter):
        for title, group in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name, text) for name, (_, text) in group.items()])


@click.command(
    cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(__version__, prog_name="sparsegaze")
def cli():
    """Gaze from six LEDs, computed on the microcontroller that reads them.

    \b
    With no hardware, in two terminals:
        sparsegaze virtual --link /tmp/nano        a virtual Nano and its simulated person
        sparsegaze flash /tmp/nano
        sparsegaze calibrate /tmp/nano
        sparsegaze stream /tmp/nano --seconds 20 --csv gaze.csv
    With a real Nano: the same, with its own port (sparsegaze list shows it).

    PORT is a name such as /dev/ttyUSB0, COM3 or the one that `virtual` prints. Angles are degrees, azimuth +
    right, elevation + up. Every command has its own --help and, with --json, prints one JSON object on
    stdout.
    """


class Terminated(KeyboardInterrupt):
    """SIGTERM: the same orderly end as Ctrl-C, another exit code."""


def main(args=None):
    """Entry point: run the command line `args` (default sys.argv) and exit with its code."""
    args = list(sys.argv[1:] if args is None else args)
    sys.exit(run(args))


def run(args):
    """Run the command line `args`; returns the exit code."""
    as_json = "--json" in args
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        warnings.showwarning = _warning
        before = _on_terminate(_terminate)
        try:
            code = cli.main(args, prog_name="sparsegaze", standalone_mode=False)
            sys.stdout.flush()
            return code if isinstance(code, int) else 0
        except click.exceptions.Exit as done:
            return done.exit_code
        except click.UsageError as error:
            place = error.ctx.command_path if error.ctx else "sparsegaze"
            return _fail(as_json, error.format_message().rstrip("."), f"see {place} --help", 2)
        except click.ClickException as error:
            return _fail(as_json, error.format_message(), "", 1)
        except SparsegazeError as error:
            if os.environ.get("SPARSEGAZE_DEBUG"):
                raise
            return _fail(as_json, error.message, error.remedy, 1)
        except (KeyboardInterrupt, click.Abort) as error:
            terminated = isinstance(error, Terminated)
            return _fail(
                as_json,
                "terminated" if terminated else "interrupted",
                "what was written so far is complete",
                143 if terminated else 130,
            )
        except BrokenPipeError:
            # The reader of our output has gone; let the interpreter's own flush at exit find nothing to
            # complain of.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except Exception as error:
            if os.environ.get("SPARSEGAZE_DEBUG"):
                raise
            return _unexpected(as_json, error)
        finally:
            _on_terminate(before)


def _unexpected(as_json, error):
    if isinstance(error, ImportError):
        return _fail(
            as_json,
            f"a part of sparsegaze cannot be loaded ({error})",
            "sparsegaze doctor says what is missing",
            1,
        )
    if isinstance(error, OSError) and error.strerror:
        return _fail(
            as_json,
            f"{error.strerror}" + (f": {error.filename}" if error.filename else ""),
            "check the place and the free space there",
            1,
        )
    return _fail(
        as_json,
        f"internal error ({type(error).__name__}: {error})",
        "this is a bug: run again with SPARSEGAZE_DEBUG=1 and report what it prints",
        1,
    )


def _fail(as_json, message, remedy, code):
    """One line on stderr, with --json the same as an object on stdout; returns the exit code."""
    message, remedy = " ".join(str(message).split()), " ".join(str(remedy).split())
    sys.stderr.write(f"sparsegaze: {message}" + (f" — {remedy}" if remedy else "") + "\n")
    sys.stderr.flush()
    if as_json:
        sys.stdout.write(json.dumps({"error": message, "remedy": remedy}) + "\n")
        sys.stdout.flush()
    return code


def _warning(message, category, filename, lineno, file=None, line=None):
    if issubclass(category, UserWarning):
        sys.stderr.write(f"sparsegaze: warning: {' '.join(str(message).split())}\n")


def _terminate(number, frame):
    signal.signal(number, signal.SIG_IGN)  # a second one would interrupt the cleaning up
    raise Terminated


def _on_terminate(handler):
    try:
        return signal.signal(signal.SIGTERM, handler)
    except ValueError:  # not in the main thread (tests): whoever runs us deals with signals
        return None


if __name__ == "__main__":
    main()
