# SPDX-License-Identifier: Apache-2.0
"""`sparsegaze doctor HEADSET.toml`: is it safe for eyes, and what does it draw."""

from .console import table
from .eyesafety import examine
from .headset import load_headset
from .power import PAPER_LED_MW, PAPER_PHOTODIODE_MW, budgets


def examine_headset(path, console):
    """Print what a headset file says about eyes and power; returns the exit code, 1 over any limit.

    path   of the headset file          console   Console
    Raises SceneError for a file that is no headset, or lacks what has to be known.
    """
    headset = load_headset(path)
    report, drawn = examine(headset), budgets(headset)
    data = {
        "ok": report.ok,
        "headset": headset.name,
        "eye_safety": report.report(),
        "power": [one.report() for one in drawn],
        "paper_mw": {"leds": PAPER_LED_MW, "photodiodes": PAPER_PHOTODIODE_MW},
    }
    console.result(data, *_safety_lines(headset, report), "", *_power_lines(drawn))
    return 0 if report.ok else 1


def _safety_lines(headset, report):
    rows = [
        (
            "ok" if row.ok else "OVER",
            row.case,
            row.quantity,
            _figure(row.value),
            _figure(row.limit),
            row.unit,
            "%s x" % _figure(row.margin) if row.value > 0 else "dark",
            row.detail,
        )
        for row in report.rows
    ]
    yield "%s: infrared light at the eye, beside the exempt limits of IEC 62471" % headset.name
    yield ""
    yield from table(("", "in", "quantity", "value", "limit", "unit", "margin", "under"), rows)
    yield ""
    if report.ok:
        yield "safe: the least margin is %s x (%s, %s)" % (
            _figure(report.margin),
            report.worst.case,
            report.worst.quantity,
        )
    else:
        most = 0.99 * max(p.intensity_mw_sr for p in headset.emitters) * report.margin
        over = _figure(1 / report.margin), report.worst.case, report.worst.quantity
        yield (
            "NOT SAFE: %s x the limit (%s, %s) -> emitters of at most" % over
            + " %.3g mW/sr: less current, or others" % most
        )
    for sentence in report.assumed:
        yield "  - " + sentence
    yield "  - nearest emitter to the cornea: %.1f mm, %.1f at worst" % report.nearest_mm


def _power_lines(drawn):
    rows = [
        (one.setting, "%.0f" % one.rate_hz)
        + tuple("%.0f" % mw for mw in (one.emitter_mw, one.mcu_mw, one.rail_mw, one.total_mw))
        for one in drawn
    ]
    rows.append(("paper, LEDs", "250", "", "", "", "%.0f" % PAPER_LED_MW))
    rows.append(("paper, photodiodes", "400", "", "", "", "%.0f, no computer" % PAPER_PHOTODIODE_MW))
    yield "power at 5 V, mW"
    yield ""
    yield from table(("setting", "Hz", "emitters", "mcu", "rail", "total"), rows)
    yield ""
    yield "  - an Arduino Nano's USB chip and power LED draw %.0f mW more" % drawn[0].board_mw


def _figure(value):
    """Three digits, without an exponent while that is readable."""
    if value == 0 or 0.01 <= abs(value) < 1000:
        return "%.3g" % value
    return "{:,.0f}".format(value) if abs(value) < 1e6 else "%.1e" % value
