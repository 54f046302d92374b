# SPDX-License-Identifier: Apache-2.0
"""The section faults: a person who looks about, blinks and wears a headset that breaks.

Each person of the section device, on the model of the dark at nominal light, in every ambient light at the
default setting and in some at 4 cycles a frame. The gaze stream is kept without a gap beside where the
simulated eye really looked; every frame counts, those of saccades and of lids too. A gaze that is called
VALID and is more than WILD_DEG off is wild.
"""

import os
import shutil
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import frontend_persons
import numpy as np
from frontend_board import Board, calibrated
from frontend_measures import AMBIENTS, STEP_NA

from sparsegaze import metrics
from sparsegaze.wire import lib

WILD_DEG = 5.0
CYCLES_PER_US = 16
# (cycles a frame, lights)
SETTINGS = ((1, AMBIENTS), (4, ("room", "sun_gap")))
QUICK_SETTINGS = ((1, ("dark", "sun_gap")),)
EXPECTED = {  # fault of a part: the names in status that say what is seen of it
    "open": {"open"},
    "short": {"short"},
    "short_ground": {"open"},  # a node that stays at 0 V collects nothing
    "covered": {"low", "open"},
    "finger": {"high"},
}
SECONDS = (4, 3, 0)  # those that are sampled second of a pair: what is open there repeats the first
SWAPS = ((0, 5), (1, 4), (2, 3), (0, 3), (1, 2), (4, 5))
SUPPLY_VOLTS, SAGS = 5.0, (0.02, 0.03, 0.04, 0.06, 0.14)
ALARM_KINDS = ("supply -6 %", "supply -14 %")  # the alarm begins at 4 %, in codes of half a per cent
TARGET_S, WITHIN_DEG = 0.4, 18.0
ABOUT_S, BLINKS, BLINK_S, STEPS, STEP_S = 8.0, 6, 0.9, 12, 0.3
BEFORE_S, POLL_S, MOST_S, SUPPLY_S, SWAP_S, KEPT_S = 0.3, 0.05, 3.0, 2.8, 1.2, 0.2
AFTER_S, BACK_S = 1.2, 0.4
FOUND = np.dtype([("us", "f8"), ("gaze_deg", "f8", (2,)), ("flags", "u1"), ("error_deg", "f8")])
FAULTLESS = ("looking about", "blinks", "ambient steps")


class Watch:
    """The gaze stream of a board from now on, without a gap, and where the eye looks meanwhile."""

    def __init__(self, board, folder):
        self.board, self.control = board, board.control
        self._truth = Path(folder) / "truth.csv"
        self.control.truth(self._truth)
        board.device.set_stream(gaze=True)
        self._stream, self._rows, self._named = board.device.frames(5.0), [], []
        self.now = board.now_us()
        self.wait(0.05)

    def until(self, us):
        """Frames up to virtual time `us`."""
        offset = self.board.offset_us
        while self.now < us:
            frame = next(self._stream)
            gaze = frame.gaze
            if gaze is not None:
                self.now = frame.t_us - offset
                self._rows.append((self.now, (gaze.azimuth_deg, gaze.elevation_deg), gaze.flags))

    def wait(self, seconds):
        self.until(self.now + 1e6 * seconds)

    def names(self):
        """(virtual time of the answer, [6] sets of channels' faults, set of alarms)."""
        status = self.board.device.status()
        return self.board.now_us(), [set(of) for of in status.faults], set(status.alarms)

    def table(self):
        """All frames so far as FOUND; the eye's log is closed."""
        self.control.truth(None)
        truth = np.loadtxt(self._truth, delimiter=",", skiprows=1, usecols=(0, 1, 2), ndmin=2)
        found = np.zeros(len(self._rows), FOUND)
        for name, column in zip(("us", "gaze_deg", "flags"), zip(*self._rows)):
            found[name] = column
        eye = [np.interp(found["us"], truth[:, 0], truth[:, k]) for k in (1, 2)]
        found["error_deg"] = metrics.frame_errors_deg(*found["gaze_deg"].T, *eye)
        return found


def measure(seeds, folder, quick, say, jobs=None):
    """{"faults": summary} of the persons `seeds`."""
    frontend_persons.maps(seeds, say)
    jobs = min(jobs or os.cpu_count() or 1, 2, len(seeds))
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the processes are as many as the cores
    done = []
    if jobs == 1:
        for seed in seeds:
            done += person(seed, str(folder), quick, say)
    else:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            running = [pool.submit(person, seed, str(folder), quick) for seed in seeds]
            for finished in as_completed(running):
                done += finished.result()
    return {"faults": summary(sorted(done, key=lambda one: one["seed"]))}


def summary(episodes):
    """What episodes say together: rows by kind and cycles a frame, and those where something was amiss."""
    rows = []
    for repeats in sorted({one["repeats"] for one in episodes}):
        for kind in dict.fromkeys(one["kind"] for one in episodes):
            group = [one for one in episodes if (one["kind"], one["repeats"]) == (kind, repeats)]
            if group:
                rows.append({"kind": kind, "repeats": repeats, **together(kind, group)})
    amiss = [one for one in episodes if one["wild"] or one["fault_frames"] and one["kind"] in FAULTLESS]
    due = [one for one in episodes if to_name(one["kind"])]
    amiss += [one for one in due if one["named_ms"] is None and one not in amiss]
    return {"rows": rows, "amiss": amiss, "episodes": len(episodes)}


def to_name(kind):
    """Must status name it?"""
    return kind.split(",")[0] in EXPECTED or kind in ALARM_KINDS


def together(kind, group):
    """One row of several episodes of a kind."""
    named = [one["named_ms"] for one in group if one["named_ms"] is not None]
    frames = sum(one["frames"] for one in group)
    wild = sum(one["wild"] for one in group)

    def mean(key):
        found = [one[key] for one in group if one[key] is not None]
        return float(np.mean(found)) if found else None

    return {
        "episodes": len(group),
        "named": len(named) if to_name(kind) or named else None,
        "named_ms": float(np.median(named)) if named else None,
        "named_ms_worst": max(named, default=None),
        "valid_before": mean("valid_before"),
        "valid_while": mean("valid_while"),
        "valid_after": mean("valid_after"),
        "mean_deg": mean("mean_deg"),
        "frames": frames,
        "wild": wild,
        "wild_per_10000": 1e4 * wild / frames,
        "worst_deg": max(one["worst_deg"] for one in group),
        "false_alarms": sum(bool(one["fault_frames"]) for one in group) if kind in FAULTLESS else None,
    }


def look_about(board, rng, seconds):
    """Targets for so long, the eye following as people's do."""
    board.control.motion(True)
    board.control.follow(True)
    board.control.targets_clear()
    start = board.now_us()
    places = rng.uniform(-WITHIN_DEG, WITHIN_DEG, (int(seconds / TARGET_S), 2))
    for k, (azimuth, elevation) in enumerate(places):
        board.control.target(start + int(k * TARGET_S * 1e6), azimuth, elevation)


def led_fault(watch, rng, kind, channel):
    """A part breaks at some moment of an exposure, until it is named; and is whole again."""
    watch.wait(BEFORE_S)
    at = int(watch.board.now_us() + 2000 + rng.integers(0, 2000))
    watch.control.set_at(at * CYCLES_PER_US + int(rng.integers(0, CYCLES_PER_US)), f"fault_{channel}", kind)
    named = _poll(watch, at, MOST_S, lambda faults, alarms: bool(faults[channel] & EXPECTED[kind]))
    off = watch.board.now_us()
    watch.control.fault(channel, "none")
    watch.wait(AFTER_S)
    return {"kind": kind, "channel": channel, "at_us": at, "off_us": off, **named}


def _poll(watch, at, most_s, is_it):
    """Ask for the status until it names what it should. Frames go on for a little then."""
    watch.until(at)
    while watch.now < at + 1e6 * most_s:
        watch.wait(POLL_S)
        us, faults, alarms = watch.names()
        if is_it(faults, alarms):
            watch.wait(KEPT_S)
            return {"named_ms": (us - at) * 1e-3, "names": _words(faults, alarms)}
    return {"named_ms": None, "names": _words(faults, alarms)}


def _words(faults, alarms):
    return [f"{i} {name}" for i, names in enumerate(faults) for name in sorted(names)] + sorted(alarms)


def swapped(watch, pair):
    """The plugs of two LEDs exchanged. No name says so in status: `probe` does."""
    watch.wait(BEFORE_S)
    at = watch.board.now_us()
    watch.control.swap(*pair)
    watch.until(at + 1e6 * SWAP_S)
    _, faults, alarms = watch.names()
    off = watch.board.now_us()
    watch.control.swap(*pair)
    watch.wait(AFTER_S)
    return {"kind": "swapped", "channel": pair, "at_us": at, "off_us": off, "named_ms": None,
            "names": _words(faults, alarms)}


def supply(watch, sag):
    """The supply falls, and comes back."""
    watch.wait(BEFORE_S)
    at = watch.board.now_us()
    watch.control.supply(SUPPLY_VOLTS * (1 - sag))
    named = _poll(watch, at, SUPPLY_S, lambda faults, alarms: "supply" in alarms)
    off = watch.board.now_us()
    watch.control.supply(SUPPLY_VOLTS)
    while watch.now < off + 1e6 * SUPPLY_S and "supply" in watch.names()[2]:
        watch.wait(2 * POLL_S)
    watch.wait(AFTER_S)
    return {"kind": f"supply -{100 * sag:.0f} %", "channel": None, "at_us": at, "off_us": off, **named}


def faultless(watch, kind, act):
    """What is no fault: `act` does it. Episodes of it that are called one are false alarms."""
    at = watch.board.now_us()
    act()
    _, faults, alarms = watch.names()
    return {"kind": kind, "channel": None, "at_us": at, "off_us": watch.board.now_us(), "named_ms": None,
            "names": _words(faults, alarms)}


def blinks(watch, rng):
    """Lids that close in 70 ms, stay for 20 and open in 150; every other time half way only."""
    for k in range(BLINKS):
        at = watch.board.now_us() + 1000 * int(rng.integers(20, 60))
        deep = 1.0 if k % 2 == 0 else 0.55
        for ms in range(0, 241, 4):
            opening = 1 - deep * _smooth(min(ms / 70, (240 - ms) / 150))
            watch.control.set_at((at + 1000 * ms) * CYCLES_PER_US, "lid", f"{opening:.4f}")
        watch.control.set_at((at + 241_000) * CYCLES_PER_US, "lid", "auto")
        watch.wait(BLINK_S)


def _smooth(x):
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (10 + x * (6 * x - 15))


def ambient_steps(watch, rng):
    """1000:1 up and down, at moments that no exposure knows; dark again."""
    for k in range(STEPS):
        at = (watch.board.now_us() + 2000) * CYCLES_PER_US + int(rng.integers(0, 16000))
        watch.control.set_at(at, "ambient_na", STEP_NA[(k + 1) % 2])
        watch.wait(STEP_S)
    watch.control.set("ambient", "dark")
    watch.wait(STEP_S)


def plan(light, repeats, turn, quick):
    """What is done in a light: lists of (LED fault, channel), pairs to swap, sags; turn counts lights and
    persons, so that every channel has its turn."""
    kinds, many = list(EXPECTED), 1 if quick else 2
    leds = [(kind, (turn + n + 3 * j) % 6) for n, kind in enumerate(kinds) for j in range(many)]
    sags = SAGS if light in ("dark", "sun_gap") else ()
    return leds, [SWAPS[turn % len(SWAPS)]], sags[::3] if quick else sags


def in_light(board, light, repeats, turn, quick, rng, folder):
    """Everything in one light: episodes, a list of dicts."""
    board.device.settings(repeats=repeats)
    board.control.set("ambient", light)
    look_about(board, rng, 150)
    board.device.link.sleep(1.0)
    watch, done = Watch(board, folder), []
    leds, pairs, sags = plan(light, repeats, turn, quick)
    done.append(faultless(watch, "looking about", lambda: watch.wait(ABOUT_S / 4 if quick else ABOUT_S)))
    done.append(faultless(watch, "blinks", lambda: blinks(watch, rng)))
    done += [led_fault(watch, rng, kind, channel) for kind, channel in leds]
    done += [swapped(watch, pair) for pair in pairs]
    done += [supply(watch, sag) for sag in sags]
    if light == AMBIENTS[0] or (repeats > 1 and light == "room"):
        done.append(faultless(watch, "ambient steps", lambda: ambient_steps(watch, rng)))
    if light == AMBIENTS[0]:
        board.control.motion(False)
        board.control.follow(False)
        board.control.targets_clear()
        board.control.target(board.now_us(), 3.0, -2.0)
        watch.wait(1.0)
        for channel in SECONDS[:1] if quick else SECONDS:
            one = led_fault(watch, rng, "open", channel)
            done.append({**one, "kind": "open, second of a pair, still eye"})
    table = watch.table()
    for one in done:
        one.update(light=light, repeats=repeats, **figures(table, one))
    return done


def figures(table, one):
    """What an episode's frames say."""
    us, at, off = table["us"], one["at_us"], one["off_us"]
    valid = (table["flags"] & lib.SG_FLAG_VALID) != 0
    fault = (table["flags"] & lib.SG_FLAG_FAULT) != 0
    quiet = one["kind"] in FAULTLESS
    end = off if quiet else off + 1e6 * AFTER_S
    while_ = (us >= at) & (us < off)
    all_ = (us >= at) & (us < end)
    flagged = us[while_ & fault]

    def share(rows):
        return float(valid[rows].mean()) if rows.any() else None

    return {
        "valid_before": share((us >= at - 1e6 * BEFORE_S) & (us < at)),
        "valid_while": share(while_),
        "valid_after": None if quiet else share((us >= end - 1e6 * BACK_S) & (us < end)),
        "flag_ms": float(flagged[0] - at) * 1e-3 if len(flagged) else None,
        "frames": int(all_.sum()),
        "valid_frames": int((all_ & valid).sum()),
        "wild": int((all_ & valid & (table["error_deg"] > WILD_DEG)).sum()),
        "worst_deg": float(np.max(table["error_deg"], initial=0.0, where=all_ & valid)),
        "mean_deg": float(np.mean(table["error_deg"][while_ & valid])) if (while_ & valid).any() else None,
        "fault_frames": int((while_ & fault).sum()),
    }


def person(seed, folder, quick, say=None, **options):
    """Episodes of one person: a list of dicts."""
    say = say or (lambda text: print("           faults   " + text, flush=True))
    kept, _ = calibrated(seed, "nominal", Path(folder), say)
    rng, done = np.random.default_rng([0xFA, seed]), []
    with tempfile.TemporaryDirectory(prefix="sgw-") as temporary:
        state = Path(temporary) / "state"
        shutil.copytree(kept, state)
        for k, (repeats, lights) in enumerate(QUICK_SETTINGS if quick else SETTINGS):
            for j, light in enumerate(lights):
                with Board(seed, state, **options) as board:
                    turn = seed + 2 * j + k
                    found = in_light(board, light, repeats, turn, quick, rng, temporary)
                done += [{"seed": seed, **one} for one in found]
        wild, frames = (sum(one[key] for one in done) for key in ("wild", "frames"))
        say(f"person {seed}: {len(done)} episodes, {wild} of {frames} frames VALID and wild")
    return done
