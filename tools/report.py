# SPDX-License-Identifier: Apache-2.0
"""Write README.md's result table from build/demo/report.json (made by `make demo`).

    python tools/report.py             rewrite the table between the README's two markers
    python tools/report.py --check     exit 1 when the README's table is not what the report says
"""
import argparse
import json
import sys
from pathlib import Path

BEGIN = "<!-- results: written by tools/report.py from build/demo/report.json -->"
END = "<!-- /results -->"


def table(report):
    """The Markdown table of a report dict."""
    accuracy, stream, delay = report["accuracy"], report["stream"], report["latency_ms"]
    rows = [
        ("mean / median / p95 error to the target",
         f"**{accuracy['mean_deg']:.2f}** / {accuracy['median_deg']:.2f} / {accuracy['p95_deg']:.2f} deg", "1.57 / 1.12 / - deg"),
        ("the same by the full float64 GP, on the same samples", f"{accuracy['gp64_mean_deg']:.2f} deg", "-"),
        ("mean error to where the simulated eye really looked", f"{accuracy['to_true_gaze_mean_deg']:.2f} deg", "-"),
        ("accuracy, precision RMS-S2S (ETDQualitizer)",
         f"{accuracy['accuracy_deg']:.2f} deg, {accuracy['rms_s2s_deg']:.2f} deg", "-"),
        ("data loss (blinks, out of range)", f"{100 * accuracy['data_loss']:.1f} %", "-"),
        ("gaze rate, device time", f"{stream['rate_hz']:.1f} Hz", "250 Hz"),
        ("frames streamed, lost, differing from the host core", f"{stream['frames']}, {stream['lost']}, {stream['differing']}", "-"),
        ("where the gaze is computed", f"on the ATmega328P, {report['model']['n_vectors']} vectors", "on a PC"),
        ("inference, all work on a frame (worst)",
         f"{report['inference']['cycles']:,.0f}, {report['frame']['cycles']:,.0f} of {report['frame']['period_cycles']:,.0f} cycles",
         "-"),
        ("latency to the last byte, from mean sample time, from last sample",
         f"{delay['mean_sample_to_last_byte']:.2f} ms, {delay['last_sample_to_last_byte']:.2f} ms", "-"),
        ("flashed through the stock bootloader, verified",
         f"{report['flash']['bytes']} bytes in {report['flash']['seconds']:.1f} s (device time)", "-"),
    ]
    lines = [f"| figure | sparsegaze, simulated person {report['seed']} | LED2Gaze, people |", "|---|---|---|"]
    lines += [f"| {name} | {ours} | {paper} |" for name, ours, paper in rows]
    return "\n".join(lines)


def main():
    """Rewrite or check the README. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", type=Path, default=Path("build/demo/report.json"))
    parser.add_argument("--readme", type=Path, default=Path("README.md"))
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args()
    if not options.report.is_file():
        print(f"report: {options.report} is not there: run `make demo` first", file=sys.stderr)
        return 1
    text = options.readme.read_text(encoding="utf-8")
    head, _, rest = text.partition(BEGIN)
    _, found, tail = rest.partition(END)
    if not found:
        print(f"report: {options.readme} lacks the markers of the result table", file=sys.stderr)
        return 1
    wanted = f"{head}{BEGIN}\n{table(json.loads(options.report.read_text(encoding='utf-8')))}\n{END}{tail}"
    if options.check:
        return 0 if wanted == text else 1
    options.readme.write_text(wanted, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
