# SPDX-License-Identifier: Apache-2.0
"""demo.png: what the demo measured, for somebody who would rather look than read."""
import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot

BLUE, RED, GREY, GREEN = "#2f6690", "#c8553d", "#9aa5b1", "#588157"


def draw(path, report, calibration, validation):
    """Six panels into a PNG.

    report       dict of tools/demo.py
    calibration  sparsegaze.calibrate.Calibration;  validation  sparsegaze.validate.Validation
    """
    figure, axes = pyplot.subplots(2, 3, figsize=(17, 10), constrained_layout=True)
    _targets(axes[0, 0], validation)
    _errors(axes[0, 1], report, validation)
    _field(axes[0, 2], validation)
    _trace(axes[1, 0], validation)
    _features(axes[1, 1], calibration)
    _numbers(axes[1, 2], report)
    figure.suptitle(f"sparsegaze demo: virtual Nano, simulated person {report['seed']}, "
                    "gaze computed on the device", fontsize=15)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _targets(axis, validation):
    rows, plan = validation.counted, validation.run.plan.target_deg
    gaze = validation.run.gaze_deg[rows]
    axis.plot(gaze[:, 0], gaze[:, 1], ".", ms=1.2, alpha=0.25, color=BLUE, label="gaze, every valid frame")
    for row in validation.per_target():
        axis.plot([row["target_az_deg"], row["gaze_az_deg"]], [row["target_el_deg"], row["gaze_el_deg"]],
                  "-", color=RED, lw=1.6)
    axis.plot(plan[:, 0], plan[:, 1], "k+", ms=10, mew=1.6, label="held-out target")
    axis.set(title="Held-out targets", xlabel="azimuth (deg, + right)", ylabel="elevation (deg, + up)",
             aspect="equal", xlim=(-24, 24), ylim=(-24, 30))
    axis.legend(fontsize=8, loc="upper right", ncol=2, markerscale=2)


def _errors(axis, report, validation):
    error = validation.error_deg[validation.counted]
    accuracy = report["accuracy"]
    axis.hist(np.minimum(error, 3.0), bins=np.linspace(0, 3.0, 76), color=BLUE)
    for key, style in (("median_deg", "--"), ("mean_deg", "-"), ("p95_deg", ":")):
        axis.axvline(accuracy[key], color=RED, ls=style, label=f"{key[:-4]} {accuracy[key]:.2f} deg")
    axis.axvline(1.57, color=GREY, ls="-.", label="LED2Gaze, mean of 14 people 1.57 deg")
    axis.set(title=f"Error to the target, {accuracy['frames']} frames, "
                   f"data loss {100 * accuracy['data_loss']:.1f} %",
             xlabel="error per frame (deg; the last bin holds all above)", ylabel="frames")
    axis.legend(fontsize=8)


def _field(axis, validation):
    table = validation.per_target()
    x, y = np.array([[row["target_az_deg"], row["target_el_deg"]] for row in table]).T
    dots = axis.scatter(x, y, c=[row["mean_deg"] for row in table], s=330, cmap="viridis", vmin=0)
    for row in table:
        axis.annotate(f"{row['mean_deg']:.1f}", (row["target_az_deg"], row["target_el_deg"]), ha="center",
                      va="center", fontsize=8, color="white")
    axis.figure.colorbar(dots, ax=axis, label="mean error (deg)", shrink=0.8)
    axis.set(title="Where the error is", xlabel="azimuth (deg)", ylabel="elevation (deg)", aspect="equal",
             xlim=(-23, 23), ylim=(-23, 23))


def _trace(axis, validation):
    run = validation.run
    inside = run.target_index >= 0
    seconds = (run.frames["t_us"] - run.frames["t_us"][inside][0]) * 1e-6
    show = inside & (seconds >= 0) & (seconds < 9)
    valid = show & (validation.counted | ~validation.settled)
    for axis_index, (name, colour) in enumerate((("azimuth", BLUE), ("elevation", GREEN))):
        axis.plot(seconds[show], run.target_deg[show, axis_index], color="black", lw=0.8)
        axis.plot(seconds[valid], run.gaze_deg[valid, axis_index], ".", ms=1.5, color=colour, label=name)
        if validation.true_deg is not None:
            axis.plot(seconds[show], validation.true_deg[show, axis_index], color=RED, lw=0.7,
                      label="where the simulated eye looked" if axis_index else None)
    axis.set(title="The first nine seconds", xlabel="device time (s)", ylabel="gaze (deg)", ylim=(-30, 36))
    axis.legend(fontsize=8, loc="upper right", markerscale=5)


def _features(axis, calibration):
    recording = calibration.capture.recording
    valid = recording.valid
    azimuth = recording.target_deg[valid, 0]
    octaves = recording.features[valid] / 4096.0
    for i in range(octaves.shape[1]):
        axis.plot(azimuth, octaves[:, i] - np.median(octaves[:, i]) + 0.8 * i, ".", ms=2.5, alpha=0.15)
        axis.text(23.2, 0.8 * i, f"LED {i}", fontsize=9, va="center")
    axis.set(title="The six signals, calibration frames", xlabel="target azimuth (deg)",
             ylabel="log2 photocurrent about its median (octaves, spread by 0.8)", xlim=(-23, 27))


def _numbers(axis, report):
    accuracy, stream, delay, fast = (report[key] for key in ("accuracy", "stream", "latency_ms", "fast"))
    true = accuracy.get("to_true_gaze_mean_deg")
    lines = [
        ("mean error to the target", f"{accuracy['mean_deg']:.3f} deg"),
        ("full float64 GP, same samples", f"{accuracy['gp64_mean_deg']:.3f} deg"),
        ("mean error to where the eye looked", "-" if true is None else f"{true:.3f} deg"),
        ("accuracy (ETDQualitizer)", f"{accuracy['accuracy_deg']:.3f} deg"),
        ("precision RMS-S2S", f"{accuracy['rms_s2s_deg']:.3f} deg"),
        ("gaze rate, device time", f"{stream['rate_hz']:.1f} of at most {stream['limit_hz']:.0f} Hz"),
        ("frames streamed / lost", f"{stream['frames']} / {stream['lost']}"),
        ("bit-identical with the host core", "yes" if stream["bit_identical"] else "NO"),
        ("calibration vectors on the device", f"{report['model']['n_vectors']}"),
        ("inference, worst", f"{report['inference']['cycles']:.0f} cycles"),
        ("all work on a frame, worst",
         f"{report['frame']['cycles']:.0f} of {report['frame']['period_cycles']:.0f} cycles"),
        (f"gaze alone, {fast['n_vectors']} vectors", f"{fast['rate_hz']:.1f} Hz, {fast['lost']} lost"),
        ("its mean sample to last byte (worst)",
         f"{delay['mean_sample_to_last_byte']:.2f} ({delay['mean_sample_to_last_byte_max']:.2f}) ms"),
        ("its last sample to last byte (worst)",
         f"{delay['last_sample_to_last_byte']:.2f} ({delay['last_sample_to_last_byte_max']:.2f}) ms"),
        ("flash written and verified", f"{report['flash']['bytes']} bytes"),
    ]
    axis.axis("off")
    axis.set_title("Measured in this run")
    for i, (name, value) in enumerate(lines):
        height = 0.96 - i * 0.067
        axis.text(0.0, height, name, fontsize=12, transform=axis.transAxes)
        axis.text(1.0, height, value, fontsize=12, ha="right", transform=axis.transAxes, family="monospace")
