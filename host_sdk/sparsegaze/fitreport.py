# SPDX-License-Identifier: Apache-2.0
"""What `sparsegaze fit` says of a model: as one dict for programs, as lines for people."""

import math

from . import choose
from .calibrate import plain


def summary(fitted):
    """A FitResult as plain values; degrees, Nano cycles, bytes. Keys are part of the command's interface."""
    model, report = fitted.model, plain(fitted.report)
    out = {"n_vectors": model.vectors, "crc": model.crc, "bytes": len(model.image)}
    if fitted.gp is not None:
        gp, distil = fitted.gp, fitted.report.distil
        out.update(
            kernel=plain(gp.describe()),
            lml=report["lml"],
            leave_one_out={"rms_deg": report["loo_rms_deg"], "mean_deg": report["loo_mean_deg"]},
            condition=gp.condition,
            jitter=gp.jitter,
            n_full=len(gp.x),
            formats={
                "inputs": "u8.4, 64 steps a length scale",
                "centres": "u8",
                "kernel": "Q0.16",
                "weights": f"s16, 2^-{model.weight_frac_bits} deg",
                "trend": f"s16, 2^-{model.weight_frac_bits + 12} deg a step",
                "accumulator": f"s24, 2^-{model.weight_frac_bits + 8} deg",
                "reach_deg": distil.reach_deg[0],
                "accumulator_deg": distil.reach_deg[1],
            },
            error_bound_deg=distil.error_bound_deg,
            rms_to_gp_deg=report["rms_to_gp_deg"],
            max_to_gp_deg=report["max_to_gp_deg"],
            held_out_rows=report["held_out_rows"],
            cycles=report["cycles"],
            rates_hz=choose.rates_hz(model.vectors),
            predicted_deg=math.hypot(report["loo_mean_deg"], report["rms_to_gp_deg"]),
        )
    return plain({**out, "report": report})


def rate_words(rates_hz):
    """choose.rates_hz in words."""
    return (
        f"{rates_hz['gaze']} Hz; {rates_hz['recentred']} after a recentring, {rates_hz['features']} with the "
        "features streamed too"
    )


def lines(summary):
    """(name, text) pairs that say what was made and whether it is any good."""
    if "kernel" not in summary:
        return [("vectors", f"{summary['n_vectors']}, crc 0x{summary['crc']:08X}")]
    report, left_out, formats = summary["report"], summary["leave_one_out"], summary["formats"]
    rates = summary["rates_hz"]
    rows = "frames it has not seen" if summary["held_out_rows"] else "likely inputs"
    items = [
        (
            "recording",
            f"{report['fixations']} targets, {report['frames']} frames, {report['rejected_frames']} blinked",
        ),
        (
            "full process",
            f"{summary['kernel']['kernel']} on {summary['n_full']} rows; misses targets it was not told "
            f"by {left_out['mean_deg']:.2f} deg (rms {left_out['rms_deg']:.2f})",
        ),
        (
            "numerics",
            f"log likelihood {summary['lml']:.1f}, condition {summary['condition']:.1e}, "
            f"jitter {summary['jitter']:g}",
        ),
        (
            "device model",
            f"{summary['n_vectors']} vectors, {summary['bytes']} bytes, crc 0x{summary['crc']:08X}; "
            f"an inference takes {summary['cycles']} cycles on the Nano, {summary['cycles'] / 16e3:.2f} ms",
        ),
        (
            "its distance",
            f"rms {summary['rms_to_gp_deg']:.3f}, at most {summary['max_to_gp_deg']:.2f} deg "
            f"from the full process, on {rows}",
        ),
        (
            "foreseen",
            f"{summary['predicted_deg']:.2f} deg in the mean from targets it was not told (at the rim more, "
            f"inside less), at up to {rate_words(rates)}",
        ),
        (
            "its arithmetic",
            f"within {summary['error_bound_deg']:.3f} deg of real numbers, proven; sums stay below "
            f"{formats['reach_deg']:.0f} of the {formats['accumulator_deg']:.0f} deg that fit",
        ),
    ]
    if summary["kernel"]["repair"]:
        items.insert(2, ("covariance", summary["kernel"]["repair"]["words"]))
    if report["outliers"]:
        told = ", ".join(f"{az:+.1f} {el:+.1f}" for az, el in report["outliers"])
        items.append(("left out", f"targets that contradict all others: {told} deg"))
    return items
