# SPDX-License-Identifier: Apache-2.0
"""What is measured on a calibrated board (frontend_board.Board): one function a row of the benchmark's
table."""

import numpy as np
from frontend_board import error_deg, valid
from frontend_latency import latency

from sparsegaze import metrics
from sparsegaze.wire import lib

CPU_MHZ = 16.0
REST_S = 0.5
AVERAGED = 4  # frames of 1000 Hz that make one of 250 Hz
AMBIENTS = ("dark", "room", "bright_room", "sun_gap")
FREE_FRAMES = 5  # after a change of light, frames that may be saturated
STEP_NA = (2.0, 2000.0)  # 1000:1
STEP_S, STEADY, WINDOW = 0.2, slice(50, 90), 5
SETTLED, USUAL = 1.1, 0.99
SIGNAL_NA = 200.0
FLICKER = 0.5
HOLDS = (1.0, 0.7, 0.4)  # of the exposures that automatic exposure had chosen
SHIFT_PLACES = ((0, 0), (-12, -12), (12, -12), (-12, 12), (12, 12))


def precision(board, places=None):
    """RMS-S2S and error over the grid, the eye still: dict of s2s_deg, s2s_250_deg, error_deg, ..."""
    frames, target, index = board.grid(places)
    return {**judge_grid(frames, target, index), "exposure_us": list(board.device.exposure().exposure_us)}


def judge_grid(frames, target, index):
    """The figures of precision() of frames with targets [n, 2] and places' index [n]."""
    error, passed = error_deg(frames, target), valid(frames)
    each = []
    for k in range(index.max() + 1):
        rows = np.flatnonzero((index == k) & passed)
        if len(rows) < 2 * AVERAGED:
            continue
        gaze = frames["gaze_deg"][rows]
        whole = gaze[: len(rows) // AVERAGED * AVERAGED].reshape(-1, AVERAGED, 2).mean(axis=1)
        slow = metrics.rms_s2s_deg(*whole.T)
        bias = metrics.frame_errors_deg(*gaze.mean(axis=0)[:, None], *target[rows[:1]].T)[0]
        slow_error = metrics.frame_errors_deg(*whole.T, *np.repeat(target[rows[:1]], len(whole), 0).T).mean()
        each.append((metrics.rms_s2s_deg(*gaze.T), slow, error[rows].mean(), slow_error, bias))
    settled = index >= 0
    s2s, slow, errors, slow_errors, bias = np.array(each).T if each else np.full((5, 1), np.nan)
    return {
        "s2s_deg": float(s2s.mean()),
        "s2s_worst_place_deg": float(s2s.max()),
        "s2s_250_deg": float(slow.mean()),
        "error_deg": float(errors.mean()),
        "error_250_deg": float(slow_errors.mean()),
        "bias_deg": float(bias.mean()),
        "valid": float(np.mean(passed[settled])) if settled.any() else 0.0,
        "places": len(each),
        "frames": int(settled.sum()),
    }


def ambient(board, name, repeats=1):
    """precision() in an ambient light of physics.toml, how many frames after its coming were saturated, and
    how many of a second were lost and which share late."""
    board.device.settings(repeats=repeats)
    rest(board)
    board.control.set("ambient", name)
    came = board.frames(0.3)
    found = precision(board)
    found["saturated_after"] = saturated_after(came)
    found["rate_hz"] = rate_of(came)
    before = board.device.status()
    steady = board.frames(1.0)
    after = board.device.status()
    found["lost"] = int(steady["seq"][-1] - steady["seq"][0]) + 1 - len(steady)
    # A STATUS makes a few late itself: a share of those few is none.
    found["late"] = ((after.late_frames - before.late_frames) & 0xFFFF) / ((after.frames - before.frames) & 0xFFFF)
    rest(board)
    board.device.settings(repeats=1)
    return found


def rest(board):
    """Dark, and the eye straight ahead, until exposures rest."""
    board.control.set("ambient", "dark")
    board.look(0, 0)
    board.frames(REST_S)


def saturated_after(frames, free=FREE_FRAMES):
    """Frames flagged as saturated, those first ones apart."""
    return int(np.sum((frames["flags"][free:] & lib.SG_FLAG_SATURATED) != 0))


def rate_of(frames):
    """Frames received per second of device time."""
    return float((len(frames) - 1) / (frames["t_us"][-1] - frames["t_us"][0]) * 1e6)


def flicker(board, repeats=1):
    """Errors in steady light of the signal's size, and in light that flickers at 100 and 120 Hz."""
    found = {}
    board.device.settings(repeats=repeats)
    for name, depth, hz in (("steady", 0.0, 100), ("100", FLICKER, 100), ("120", FLICKER, 120)):
        rest(board)
        board.control.ambient(SIGNAL_NA, depth, hz)
        board.frames(0.3)
        found[name] = precision(board)
    rest(board)
    board.device.settings(repeats=1)
    return found


def steps(board, repeats, rng, cycles=1, place=(4.0, -6.0)):
    """Ambient steps of 1000:1 up and down, at moments that no exposure knows: dict of up and down.

    cycles   of a frame
    """
    board.device.settings(repeats=cycles)
    apart_s = STEP_S * (1 if cycles == 1 else cycles / 2)
    rest(board)
    board.look(*place)
    board.control.ambient(STEP_NA[0])
    board.frames(0.3)
    at, moment = [], board.now_us() + 50_000
    for k in range(2 * repeats):
        moment += int(apart_s * 1e6) + int(rng.integers(0, 2000))
        at.append(moment)
        board.control.set_at(
            int(moment * CPU_MHZ) + int(rng.integers(0, 16)), "ambient_na", STEP_NA[(k + 1) % 2]
        )
    frames = board.frames((at[-1] - board.now_us()) * 1e-6 + 2 * apart_s)
    rest(board)
    board.device.settings(repeats=1)
    error = error_deg(frames, np.tile(place, (len(frames), 1)))
    begin = np.searchsorted(frames["t_us"] - board.offset_us, at)
    return {"up": judge_steps(frames, error, begin[0::2]), "down": judge_steps(frames, error, begin[1::2])}


def judge_steps(frames, error, begin):
    """Saturated frames of the worst step, frames until settled, errors by frame after the step.

    begin   [k] index of the first frame after each step
    settled: the mean over steps and a window of WINDOW frames within SETTLED of the steady one, and those
    frames valid as often as steady ones (USUAL of that share: sunlight flags a few for ever)
    """
    rows = begin[:, None] + np.arange(STEADY.stop)
    rows = rows[rows[:, -1] < len(frames)]
    saturated = ((frames["flags"][rows] & lib.SG_FLAG_SATURATED) != 0).sum(axis=1)
    table = error[rows]
    whole = np.isfinite(table)
    steady = float(np.mean(table[:, STEADY], where=whole[:, STEADY])) if whole[:, STEADY].any() else np.nan
    usual = USUAL * whole[:, STEADY].mean()
    settle = None
    for k in range(STEADY.start):
        window = table[:, k : k + WINDOW]
        if (
            whole[:, k : k + WINDOW].mean() >= usual
            and np.mean(window, where=np.isfinite(window)) <= SETTLED * steady
        ):
            settle = k
            break
    course = [float(np.nanmean(column)) if np.isfinite(column).any() else None for column in table.T]
    return {
        "saturated_frames": int(saturated.max()),
        "settle_frames": settle,
        "steady_deg": steady,
        "worst_valid_deg": float(
            np.max(table[:, : STEADY.start], initial=0.0, where=whole[:, : STEADY.start])
        ),
        "steady_worst_deg": float(np.max(table[:, STEADY], initial=0.0, where=whole[:, STEADY])),
        "course_deg": course,
        "valid": [float(v) for v in whole.mean(axis=0)],
        "steps": len(rows),
    }


def exposure_shift(board):
    """How far the mean gaze moves when nothing but the exposures changes, at the worst of some places."""
    rest(board)
    chosen = np.array(board.device.exposure().exposure_us)
    mean, s2s = [], []
    for factor in HOLDS:
        board.device.exposure(us=chosen * factor)
        board.frames(0.03)
        frames, _, index = board.grid(SHIFT_PLACES, 0.2, 0.02)
        passed = valid(frames)
        gaze = [frames["gaze_deg"][(index == k) & passed] for k in range(len(SHIFT_PLACES))]
        mean.append([one.mean(axis=0) for one in gaze])
        s2s.append([metrics.rms_s2s_deg(*one.T) for one in gaze])
    board.device.exposure(auto=True)
    moved = np.linalg.norm(np.array(mean)[1:] - np.array(mean)[0], axis=-1)
    return {
        "exposure_shift_deg": float(moved.max()),
        "rms_deg": float(np.sqrt(np.mean(moved**2))),
        "s2s_deg": float(np.mean(s2s[0])),
        "exposure_us": chosen.tolist(),
        "held": list(HOLDS),
    }


def stream(board, seconds, rng, log=None):
    """The gaze stream alone at the default setting, the person following targets: rate, losses, latency."""
    control, device = board.control, board.device
    control.motion(True)
    control.follow(True)
    control.targets_clear()
    for k, (azimuth, elevation) in enumerate(rng.uniform(-18, 18, (int(seconds) + 1, 2))):
        control.target(board.now_us() + k * 1_000_000, azimuth, elevation)
    frames = board.frames(0.2)
    device.set_stream()  # a request may delay the frame it comes in: none while the frames count
    before = device.status()
    board.resume()
    board.frames(0.1)
    lost = device.lost
    if log:
        control.frames(log)
    frames = board.frames(seconds)
    if log:
        control.frames(None)
    device.set_stream()
    after = device.status()
    board.resume()
    period = np.diff(frames["t_us"])
    numbered = int(frames["seq"][-1] - frames["seq"][0]) + 1
    board.still()
    return {
        "seconds": float(np.ptp(frames["t_us"]) * 1e-6),
        "rate_hz": rate_of(frames),
        "late": _grown(before, after, "late_frames") + _grown(before, after, "late_slots"),
        "lost": max(numbered - len(frames), device.lost - lost) + _grown(before, after, "tx_dropped"),
        "frame_cycles_max": after.cycles_max,
        "jitter_us": [float(period.min() - np.median(period)), float(period.max() - np.median(period))],
        "settings": device.settings()._asdict(),
        "stack_free": after.stack_free,
        "saturated": _grown(before, after, "saturated"),
        "starved": _grown(before, after, "starved"),
        "exposure_changes": _grown(before, after, "exposure_changes"),
        "latency": latency(log, int(frames["infer_us"].min())) if log else None,
    }


def _grown(before, after, name):
    return (getattr(after, name) - getattr(before, name)) & 0xFFFF
