# SPDX-License-Identifier: Apache-2.0
"""The main job on a virtual Nano, measured: flash, calibrate, stream; then report.json, demo.png, the bars.

`make demo` calls this after set-up and build. The virtual Nano starts empty: it is flashed through its
bootloader, a simulated person is calibrated in lockstep (as fast as this machine computes), the power is
cycled, and the gaze that the device computes is streamed in real time over held-out targets. Exits 1 when a
bar is missed, naming it.
"""
import argparse
import csv
import json
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from demo_picture import draw
from sparsegaze import calibrate, flash, metrics, session, store, targets, validate
from sparsegaze.device import Device
from sparsegaze.errors import SparsegazeError
from sparsegaze.fit import fit_recording
from sparsegaze.headset import load_headset
from sparsegaze.mapplot import save_maps
from sparsegaze.person import draw_person
from sparsegaze.screen import screen_for
from sparsegaze.simulate import response_map
from sparsegaze.transport import open_link
from sparsegaze.virtual import VirtualNano
from sparsegaze.wire import lib

HEADSET = Path(__file__).resolve().parent.parent / "headsets" / "led2gaze.toml"
CPU_MHZ = 16.0
ORDER = (5, 0, 1, 4, 2, 3)          # of the channels in a sensing cycle
SLACK_CYCLES = 48                   # times of the device are whole microseconds
FRESH_S, READY_S = 600.0, 240.0     # bars: whole run on a fresh clone, and when set up
LOSS_MOST = 0.2                     # bar: blinks alone cost 0.09 (15 a minute, 0.24 s and a hold for each)
TARGETS, HELD_OUT = 120, 25
ALONE_S, SETTLE_S = 4.0, 1.0        # of the gaze stream alone, for rate and latency
RESULTS = ("report.json", "demo.png", "map.png", "gaze.csv", "latency.csv", "latency_64.csv",
           "latency_features.csv", "recording.csv", "model.sgm")
SECTION_INFER, SECTION_FRAME = "0", "5"     # GPIOR0 sections of the firmware: inference, all work on a frame

# The demo's bars are about a full model; left alone, calibrate takes the fewest vectors that do, some 25. A
# thousand gazes a second, and the latency that goes with them, are for as many as fit into a millisecond.
VECTORS, FAST_VECTORS = 64, 15


def main():
    """Parse the command line, run, report. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1,
                        help="simulated person, parts, noise and targets (default 1)")
    parser.add_argument("--started", type=float, default=None,
                        help="when `make demo` began, seconds since the epoch")
    parser.add_argument("--out", type=Path, default=Path("build/demo"),
                        help="folder of the results (default build/demo)")
    parser.add_argument("--targets", type=int, default=TARGETS,
                        help=f"calibration targets (default {TARGETS})")
    parser.add_argument("--held-out", type=int, default=HELD_OUT,
                        help=f"validation targets (default {HELD_OUT})")
    parser.add_argument("--fresh", action="store_true", help="nothing was set up when `make demo` began")
    options = parser.parse_args()
    started = time.time() if options.started is None else options.started
    setup_s = time.time() - started
    for name in RESULTS:            # those of an earlier run must not pass for this one's
        (options.out / name).unlink(missing_ok=True)
    try:
        report, calibration, validation = run(options)
    except SparsegazeError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    report["setup_s"], report["fresh"] = round(setup_s, 2), options.fresh
    draw(options.out / "demo.png", report, calibration, validation)
    headset = load_headset(HEADSET)
    save_maps(response_map(headset, draw_person(options.seed)), headset, options.out / "map.png")
    report["total_s"] = round(time.time() - started, 2)
    report["bars"] = bars(report)
    (options.out / "report.json").write_text(
        json.dumps(calibrate.plain(report), indent=1) + "\n", encoding="utf-8")
    missed = [bar for bar in report["bars"] if not bar["met"]]
    for bar in report["bars"]:
        met = "ok  " if bar["met"] else "MISS"
        print(f"  {met} {bar['name']:32} {bar['value']!s:>22}   bar {bar['bar']}")
    print(f"{options.out}/report.json, gaze.csv, demo.png and map.png written: "
          f"simulated person {options.seed}, mean error {report['accuracy']['mean_deg']:.2f} deg "
          f"at {report['stream']['rate_hz']:.0f} Hz")
    for bar in missed:
        print(f"demo: bar missed: {bar['name']} is {bar['value']}, needs {bar['bar']}", file=sys.stderr)
    return 1 if missed else 0


def run(options):
    """Everything but the clock: (report dict, calibrate.Calibration, validate.Validation)."""
    out, seed = options.out, options.seed
    out.mkdir(parents=True, exist_ok=True)
    state = out / "nano"
    shutil.rmtree(state, ignore_errors=True)
    say(f"drawing simulated person {seed} and computing the response map of headsets/led2gaze.toml")
    began = time.time()
    with VirtualNano(person=seed, unpaced=True, state_dir=state, progress=progress) as nano:
        map_s = time.time() - began
        say(f"virtual Nano on {nano.port}: flashing through its bootloader")
        with open_link(nano.port) as link:
            flashed = flash.flash_hex(link, progress=progress)
        say(f"calibrating: {options.targets} targets, in lockstep with the virtual clock")
        began = time.time()
        calibration = calibrate.run(nano.port, n_targets=options.targets, vectors=VECTORS, seed=seed,
                                    n_validation=0, folder=out, progress=progress)
        calibration_s = time.time() - began
        with Device(nano.port) as device:
            before = model_crc(device)
    say(f"power cycled; streaming over {options.held_out} held-out targets in real time")
    features_log = out / "latency_features.csv"
    with VirtualNano(person=seed, state_dir=state) as nano:
        with Device(nano.port) as device:
            after = model_crc(device)
            nano.control.frames(features_log)
            nano.control.markers_clear()
            calibrated = calibration.capture.run.plan.target_deg
            plan = targets.validation_plan(options.held_out, seed, avoid_deg=calibrated)
            validation = validate.measure(device, screen_for(device), plan, csv=out / "gaze.csv",
                                          progress=progress)
            nano.control.frames(None)
            sections, counters = nano.control.markers(), nano.control.counters()
            status, period_us, limit_hz = device.status(), *timing(device)
            full = gaze_alone(device, screen_for(device), out / "latency_64.csv")
        say(f"a model of {FAST_VECTORS} vectors from the same recording, at the device's full rate")
        small = fit_recording(calibration.capture.recording, FAST_VECTORS, progress=progress).model
        store.upload(nano.port, small, progress)
        with Device(nano.port) as device:
            fast = gaze_alone(device, screen_for(device), out / "latency.csv")
    measured = validation.report()
    process = calibration.fit.gp.predict(validation.run.frames["features"].astype(float))
    gp_deg = np.asarray(process[0] if isinstance(process, tuple) else process)
    accuracy = dict(measured["accuracy"], gp64_mean_deg=validation.error_of(gp_deg).mean_deg)
    accuracy["data_loss"] = accuracy.pop("data_loss_percent") / 100.0
    accuracy.update(with_held_frames(validation))
    inside = validation.run.target_index >= 0
    measured["stream"]["limit_hz"] = limit_hz
    measured["stream"]["wall_seconds"] = float(np.ptp(validation.run.frames["host_s"][inside]))
    infer, frame = sections[SECTION_INFER], sections[SECTION_FRAME]
    infer_net, frame_net = sections[SECTION_INFER + "n"], sections[SECTION_FRAME + "n"]
    model = calibration.fit.model
    with_features = latency(features_log, validation.run.frames, validation.run.offset_us, 2)
    report = {
        "simulated": True, "seed": seed, "headset": f"headsets/{HEADSET.name}", "map_s": round(map_s, 2),
        "flash": {"bytes": flashed.bytes, "verified": flashed.verified, "seconds": round(flashed.seconds, 3),
                  "bootloader": flashed.bootloader, "baud": flashed.baud},
        "calibration": {"targets": options.targets, "seconds": round(calibration_s, 2),
                        "fit": calibrate.plain(calibration.fit.report)},
        "model": {"n_vectors": model.vectors, "bytes": len(model.image),
                  "crc_host": f"{calibration.upload.crc:08X}",
                  "crc_before": f"{before:08X}", "crc_device": f"{after:08X}"},
        "stream": measured["stream"], "accuracy": accuracy,
        # Net of interrupts, which the sensing engine and the line take in between; gross beside it.
        "inference": {"cycles": infer_net.most, "cycles_mean": infer_net.mean,
                      "cycles_with_interrupts": infer.most},
        "frame": {"cycles": frame_net.most, "cycles_mean": frame_net.mean,
                  "cycles_with_interrupts": frame.most, "period_cycles": period_us * CPU_MHZ},
        "latency_ms": fast.pop("latency_ms"), "fast": {"n_vectors": small.vectors, **fast},
        "full": {**full, "with_features_ms": with_features},
        "counters": counters,
        "device": {key: calibrate.plain(getattr(status, key)) for key in
                   ("late_frames", "late_slots", "tx_dropped", "rx_bad", "rx_overrun", "saturated", "starved",
                    "stack_free", "fault", "alarm", "supply_mv", "cycles_max")},
        "notes": measured["notes"],
    }
    return report, calibration, validation


def with_held_frames(validation):
    """The mean error without the hold after a blink (SG_FLAG_RECOVERING): what that flag is worth."""
    refused = lib.SG_FLAG_NO_MODEL | lib.SG_FLAG_OUT_OF_RANGE | lib.SG_FLAG_SATURATED | lib.SG_FLAG_STARVED
    frames = validation.run.frames
    rows = validation.settled & frames["has_gaze"] & ((frames["gaze_flags"] & refused) == 0)
    gaze, target = validation.run.gaze_deg[rows], validation.run.target_deg[rows]
    error = metrics.frame_error(gaze[:, 0], gaze[:, 1], target[:, 0], target[:, 1])
    return {"mean_without_hold_deg": error.mean_deg,
            "data_loss_without_hold": 1.0 - error.frames / max(1, int(validation.settled.sum()))}


def timing(device):
    """(frame period in us, rate in Hz that the device calls its limit) while it streams as it did."""
    device.set_stream(raw=True, gaze=True)
    now = device.settings()
    device.set_stream()
    return now.frame_period_us, now.rate_limit_hz


def gaze_alone(device, screen, path):
    """Stream gaze alone for ALONE_S, as an application would: {rate_hz, limit_hz, lost, late, latency_ms}.

    path    where the virtual Nano's log goes
    """
    rows, lost = [], device.lost
    screen.open(device)
    device.set_stream(gaze=True)
    device.link.sleep(SETTLE_S)
    before, limit_hz = device.status().late_frames, device.settings().rate_limit_hz
    screen.control.frames(path)
    for frame in device.frames():
        rows.append((frame.seq, frame.t_us, frame.gaze.infer_us))
        if frame.t_us - rows[0][1] > ALONE_S * 1e6:
            break
    screen.control.frames(None)
    late = device.status().late_frames - before
    device.set_stream()
    frames = np.zeros(len(rows), session.FRAME)
    frames["seq"], frames["t_us"], frames["infer_us"] = np.array(rows).T
    frames["has_gaze"] = True
    seconds = (rows[-1][1] - rows[0][1]) * 1e-6
    return {"rate_hz": (len(rows) - 1) / seconds, "limit_hz": limit_hz, "lost": device.lost - lost,
            "late": late, "latency_ms": latency(path, frames, screen.offset_us, packets=1)}


def model_crc(device):
    """CRC-32 of the model the device uses, computed afresh on the device over its flash; 0 without one."""
    info = device.model_info()
    return 0 if info.active == lib.SG_SLOT_NONE else device.verify(info.active).crc


def latency(path, frames, offset_us, packets):
    """Mean sample time, and last sample, to the last byte's stop bit of the gaze frame; ms of device time.

    path        the virtual Nano's log of cycles: lights, pins, samples and ends of packets
    frames      record array of session.FRAME, which say when each inference was done: the packet whose end is
                next is the gaze
    offset_us   device time minus the virtual Nano's time, to some 0.5 ms: which sensing cycle a frame is of
    packets     of a frame: 1 or 2
    Frames with anything else on the line, such as the answer to a ping, are left out.
    """
    mean, last, sent = moments(path)
    frames = frames[frames["has_gaze"]]
    at = (frames["t_us"] - offset_us) * CPU_MHZ
    nothing = SparsegazeError("the virtual Nano logged no frame whose bytes could be told apart",
                              "run the demo again")
    if not len(mean) or not len(at):
        raise nothing
    at -= np.median(at - mean[nearest(mean, at)])
    cycle = nearest(mean, at)
    first = np.searchsorted(sent, last[cycle] + frames["infer_us"] * CPU_MHZ - SLACK_CYCLES)
    alone = np.flatnonzero((np.diff(first) == packets) & (np.diff(frames["seq"]) == 1) & (np.diff(cycle) == 1)
                           & (np.abs(at - mean[cycle])[:-1] < SLACK_CYCLES))
    if not len(alone):
        raise nothing
    end, ms = sent[first[alone]], 1e-3 / CPU_MHZ
    from_mean, from_last = (end - mean[cycle[alone]]) * ms, (end - last[cycle[alone]]) * ms
    return {"frames": len(alone),
            "mean_sample_to_last_byte": from_mean.mean(), "mean_sample_to_last_byte_max": from_mean.max(),
            "last_sample_to_last_byte": from_last.mean(), "last_sample_to_last_byte_max": from_last.max()}


def moments(path):
    """Of a log, in cycles: (mean middle of six lit exposures [n], last sample [n], ends of packets).

    Rows event,cycle: lit:<mask>; drive<pin>:<3 released>; adc:<channel sampled>; delimiter. A sensing cycle
    samples the channels in ORDER, pair after pair, each pair lit and then unlit.
    """
    mean, last, sent, middles, released, lit, unlit = [], [], [], [], {}, False, 0
    with open(path, newline="", encoding="ascii") as file:
        for row in csv.DictReader(file):
            kind, _, value = row["event"].partition(":")
            cycle = int(row["cycle"])
            if kind == "lit":
                lit = value != "0"
            elif kind == "delimiter":
                sent.append(cycle)
            elif kind[:5] == "drive" and value == "3":
                released[int(kind[5:])] = cycle
            elif kind == "adc" and int(value) < len(ORDER):
                channel = int(value)
                if lit and channel == ORDER[0]:
                    middles, unlit = [], 0
                if lit and channel == ORDER[len(middles) % len(ORDER)] and channel in released:
                    middles.append((released[channel] + cycle) / 2)
                unlit += not lit
                if len(middles) == len(ORDER) and channel == ORDER[-1] and not lit and unlit == len(ORDER):
                    mean.append(np.mean(middles))
                    last.append(cycle)
    return np.array(mean), np.array(last), np.array(sent, np.int64)


def nearest(times, at):
    """Index of the nearest of `times` (ascending) for each of `at`."""
    right = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    left = right - 1
    return np.where(np.abs(at - times[left]) <= np.abs(times[np.minimum(right, len(times) - 1)] - at), left,
                    np.minimum(right, len(times) - 1))


def bars(report):
    """The bars of the demo: [{name, value, bar, met}]."""
    stream, accuracy, model, delay = (report[key] for key in ("stream", "accuracy", "model", "latency_ms"))
    limit = FRESH_S if report["fresh"] else READY_S
    gap = abs(accuracy["mean_deg"] - accuracy["gp64_mean_deg"])
    rows = [
        ("total_s", report["total_s"], f"<= {limit:.0f}", report["total_s"] <= limit),
        ("flash.verified", report["flash"]["verified"], "true", report["flash"]["verified"] is True),
        ("model.n_vectors", model["n_vectors"], ">= 64", model["n_vectors"] >= 64),
        ("model.crc_device", model["crc_device"], f"= {model['crc_host']} after a power cycle",
         model["crc_device"] == model["crc_host"] == model["crc_before"]),
        ("stream.seconds", round(stream["seconds"], 2), ">= 20, in real time",
         stream["seconds"] >= 20 and abs(stream["wall_seconds"] / stream["seconds"] - 1) < 0.05),
        ("stream.rate_hz", round(stream["rate_hz"], 2), ">= 250", stream["rate_hz"] >= 250),
        ("stream.rate_hz of its limit", round(stream["rate_hz"] / stream["limit_hz"], 3), ">= 0.99",
         stream["rate_hz"] >= 0.99 * stream["limit_hz"]),
        ("stream.lost", stream["lost"] + stream["torn"], "0", stream["lost"] + stream["torn"] == 0),
        ("stream.bit_identical", stream["bit_identical"], "true", stream["bit_identical"] is True),
        ("accuracy.mean_deg", round(accuracy["mean_deg"], 3), "<= 1.0", accuracy["mean_deg"] <= 1.0),
        ("accuracy.data_loss", round(accuracy["data_loss"], 3), f"<= {LOSS_MOST}",
         accuracy["data_loss"] <= LOSS_MOST),
        ("fast.rate_hz", round(report["fast"]["rate_hz"], 1), ">= 1000", report["fast"]["rate_hz"] >= 1000),
        ("fast.lost", report["fast"]["lost"], "0", report["fast"]["lost"] == 0),
        ("fast.latency, mean sample to last byte", round(delay["mean_sample_to_last_byte"], 3), "<= 2.5 ms",
         delay["mean_sample_to_last_byte"] <= 2.5),
        ("fast.latency, last sample to last byte", round(delay["last_sample_to_last_byte"], 3), "<= 1.5 ms",
         delay["last_sample_to_last_byte"] <= 1.5),
        ("|mean_deg - gp64_mean_deg|", round(gap, 4), "<= 0.05", gap <= 0.05),
    ]
    return [{"name": name, "value": value, "bar": bar, "met": bool(met)} for name, value, bar, met in rows]


def say(text):
    """A line of progress on stderr."""
    print(f"== {text}", file=sys.stderr, flush=True)


_last = {"stage": None, "tenth": -1}


def progress(stage, done, total):
    """A stage's progress on stderr: one line a stage on a log, updated in place on a terminal."""
    tenth = int(10 * done / total) if total else 10
    if (stage, tenth) == (_last["stage"], _last["tenth"]):
        return
    _last.update(stage=stage, tenth=tenth)
    if sys.stderr.isatty():
        sys.stderr.write(f"\r   {stage:12} {'#' * tenth}{'.' * (10 - tenth)}" + ("\n" if tenth >= 10 else ""))
    elif tenth >= 10:
        sys.stderr.write(f"   {stage} done\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
