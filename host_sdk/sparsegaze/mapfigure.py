# SPDX-License-Identifier: Apache-2.0
"""Pictures of gaze maps: every sensor's map with its place beside it, and sweeps with their parts stacked.

Needs matplotlib (the optional extra `pictures`). Directions are drawn as the wearer sees them: + temporal to
the right for the right eye, + up.
"""

import os
import tempfile

import numpy as np

from .errors import SceneError
from .mapmake import TERMS
from .ring import rise_of_glint

COLOURS = {"face": "#c9b29b", "sclera": "#8fb8de", "iris": "#5b8c5a", "glint": "#e8a33d"}
INK, FAINT, MARK = "#22303c", "#8a949e", "#d1495b"
_DPI = 120


def picture_kind(path):
    """The format that a picture's name asks for. SceneError with the remedy when there is none such, or when
    matplotlib is not installed.
    """
    try:
        import matplotlib.figure  # noqa: F401
        from matplotlib.backends.backend_agg import FigureCanvasAgg
    except ImportError as error:
        raise SceneError("pictures need matplotlib (%s)" % error, "pip install 'sparsegaze[pictures]'")
    kind = os.path.splitext(os.fspath(path))[1].lstrip(".").lower()
    if kind not in FigureCanvasAgg.get_supported_filetypes():
        raise SceneError("%s: no picture is called .%s" % (path, kind), "end the name in .png, .pdf or .svg")
    return kind


def save_figure(made, path, state=0):
    """Write the picture of one state of a GazeMap: maps, or curves when it is a sweep. The format is the
    file name's (.png, .pdf, .svg). The file appears when it is complete.
    """
    path, kind = os.fspath(path), picture_kind(path)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, columns = made.response.shape[3:]
    sweep = 1 in (rows, columns) and rows * columns > 1
    sensors = made.response.shape[1]
    across = min(sensors, 2 if sweep or sensors < 5 else 3)
    down = -(-sensors // across)
    figure = Figure(figsize=(6.1 * across, (4.2 if sweep else 3.35) * down + 0.7), layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06, wspace=0.03, hspace=0.02)
    figure.suptitle(_title(made, state, sweep), fontsize=9 if across == 1 else 13, color=INK)
    cells = np.atleast_1d(figure.subfigures(down, across)).ravel()
    for sensor, cell in enumerate(cells[:sensors]):
        draw_sweep(cell, made, sensor, state) if sweep else draw_map(cell, made, sensor, state)
    handle, temporary = tempfile.mkstemp("." + kind, ".", os.path.dirname(path) or ".")
    os.close(handle)
    try:
        figure.savefig(temporary, dpi=_DPI, format=kind, facecolor="white")
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    return path


def _title(made, state, sweep):
    names = "%s: what each sensor receives %s, %s lit" % (
        made.headset.get("name", "headset"),
        "along one line of gaze" if sweep else "over gaze",
        "its phase's emitters" if made.headset.get("phases") else "all other emitters",
    )
    slip = made.slip_mm[state]
    moved = ", slip %g, %g, %g mm" % tuple(slip) if slip.any() else ""
    where = ""
    if sweep:
        still = "elevation" if len(made.elevation_deg) == 1 else "azimuth"
        where = "%s %g deg, " % (still, getattr(made, still + "_deg")[0])
    return "%s\n%spupil %g mm, lids %.0f %% open%s, simulated person, method %s" % (
        names,
        where,
        made.pupil_mm[state],
        100 * made.lid_opening[state],
        moved,
        made.method,
    )


def draw_map(cell, made, sensor, state=0):
    """One sensor's map, in percent of its mean, and its place, into a subfigure."""
    view, place = cell.subplots(1, 2, width_ratios=(1.45, 1))
    values = made.sensor_maps(state)[sensor]
    mean = values.mean()
    draw_place(place, made, sensor, state)
    view.set_title("sensor %d" % sensor, fontsize=11, color=INK, loc="left", weight="bold")
    _axes(view, "azimuth (deg, + temporal)", "elevation (deg, + up)")
    if not mean > 0 or 1 in values.shape:
        text = "no light" if not mean > 0 else "one gaze: %.3e /mm2" % mean
        view.text(0.5, 0.5, text, ha="center", va="center", transform=view.transAxes, color=FAINT)
        return
    percent = 100 * values / mean
    azimuth, elevation = made.azimuth_deg, made.elevation_deg
    image = view.pcolormesh(azimuth, elevation, percent, cmap="viridis", shading="gouraud", rasterized=True)
    lines = view.contour(azimuth, elevation, percent, 8, colors="white", linewidths=0.7, alpha=0.8)
    view.clabel(lines, lines.levels[1::2], fmt="%g", fontsize=7)
    view.set_aspect("equal")
    bar = cell.colorbar(image, ax=view, fraction=0.05, pad=0.03)
    bar.set_label("percent of its mean, %.2e /mm2" % mean, fontsize=8, color=INK)
    bar.ax.tick_params(labelsize=7, color=FAINT)
    bar.outline.set_visible(False)


def draw_place(panel, made, sensor, state=0):
    """The headset before the eye, as its wearer sees it: eye, lids, every sensor and emitter; one sensor
    marked, with an arrow to what it looks at, and who is lit for it in amber.
    """
    person = made.person
    panel.set_aspect("equal")
    panel.set_axis_off()
    eye, slip = np.array(person["eye_position_mm"]), made.slip_mm[state]
    _eye(panel, person, made.pupil_mm[state], made.lid_opening[state], eye)
    sensors, emitters = made.headset["sensors"], made.headset["emitters"]
    shown = {tuple(p["position_mm"]): False for p in sensors}
    for p, lit in zip(emitters, made.lit[sensor]):
        shown[tuple(p["position_mm"])] = lit
    for position, lit in shown.items():
        x, y = np.add(position, slip)[:2]
        panel.plot(x, y, "o", color=COLOURS["glint"] if lit else "white", markeredgecolor=FAINT,
                   markersize=6, zorder=3)
    port = sensors[sensor]
    start, aim = np.add(port["position_mm"], slip), np.array(port["aim"])
    # to the plane of the cornea
    reach = (eye[2] - person["globe_radius_mm"] - start[2]) / aim[2] if abs(aim[2]) > 1e-3 else 10.0
    end = start + np.clip(reach, 0.0, 80.0) * aim
    panel.annotate(
        "", end[:2], start[:2], arrowprops=dict(arrowstyle="-|>", color=MARK, linewidth=1.6), zorder=5
    )
    panel.plot(*start[:2], "o", color=MARK, markeredgecolor="white", markersize=10, zorder=6)
    panel.text(
        *start[:2], str(sensor), color="white", fontsize=7, ha="center", va="center", zorder=7, weight="bold"
    )
    points = np.array([np.add(p, slip)[:2] for p in shown] + [end[:2]])
    half = max(17.0, 1.12 * np.abs(points - eye[:2]).max())
    panel.set_xlim(eye[0] - half, eye[0] + half)
    panel.set_ylim(eye[1] - half, eye[1] + half)
    panel.plot(
        [eye[0] + half - 10, eye[0] + half], [eye[1] - half] * 2, color=FAINT, linewidth=2, clip_on=False
    )
    panel.text(
        eye[0] + half - 5, eye[1] - 0.97 * half, "10 mm", fontsize=7, color=FAINT, ha="center", va="bottom"
    )
    panel.text(
        *(eye[:2] + [0, half]),
        "%.0f mm before the eye's centre" % (eye[2] - start[2]),
        fontsize=7,
        color=FAINT,
        ha="center",
        va="bottom",
    )


def _eye(panel, person, pupil_mm, opening, eye):
    """Front view of the eye between its lids, looking straight ahead."""
    half, radius = np.radians(person["canthus_deg"]), person["lid_radius_mm"]
    alpha = np.linspace(-half, half, 121)
    upper, lower = person["lid_upper_deg"], person["lid_lower_deg"]
    meet = lower + person["lid_close_at"] * (upper - lower)
    arch, line = 1 - (alpha / half) ** 2, np.radians(person["canthus_tilt_deg"]) / np.radians(45) * alpha
    margins = []
    for edge in (upper, lower):
        beta = line + np.radians(meet + opening * (edge - meet)) * arch
        margins.append((eye[0] + radius * np.sin(alpha) * np.cos(beta), eye[1] + radius * np.sin(beta)))
    outline = np.vstack([np.column_stack(margins[0]), np.column_stack(margins[1])[::-1]])
    (white,) = panel.fill(*outline.T, color="#f2f4f6", zorder=1)
    from matplotlib.patches import Circle

    # The optical axis stands off the line of sight by kappa; the limbus lies this far out on it.
    out = np.sqrt(person["globe_radius_mm"] ** 2 - person["limbus_radius_mm"] ** 2)
    shift = out * np.sin(np.radians([person["kappa_azimuth_deg"], person["kappa_elevation_deg"]]))
    for size, colour in ((person["limbus_radius_mm"], "#7d93a6"), (pupil_mm / 2, "#1d2731")):
        disc = Circle(eye[:2] + shift, size, facecolor=colour, edgecolor="none", zorder=2)
        panel.add_patch(disc)
        disc.set_clip_path(white)
    for x, y in margins:
        panel.plot(x, y, color=INK, linewidth=1.3, zorder=2.5)


def draw_sweep(cell, made, sensor, state=0):
    """One sensor along a line of gaze: its parts stacked, below them the glint alone, the spike named."""
    grid = cell.add_gridspec(2, 2, width_ratios=(2.3, 1), height_ratios=(1.9, 1))
    view = cell.add_subplot(grid[0, 0])
    draw_place(cell.add_subplot(grid[:, 1]), made, sensor, state)
    along = "azimuth" if len(made.azimuth_deg) > 1 else "elevation"
    angle = getattr(made, along + "_deg")
    total = made.sensor_maps(state)[sensor].ravel()
    mean = total.mean()
    view.set_title("sensor %d" % sensor, fontsize=11, color=INK, loc="left", weight="bold")
    across = "%s (deg, %s)" % (along, "+ temporal" if along == "azimuth" else "+ up")
    view.set_xlim(angle[0], angle[-1])
    if not mean > 0 or not made.parts:
        _axes(view, across, "percent of its mean")
        text = "no light" if not mean > 0 else "the parts were not kept"
        view.text(0.5, 0.97, text, ha="center", va="top", transform=view.transAxes, color=FAINT)
        if mean > 0:
            view.plot(angle, 100 * total / mean, color=INK, linewidth=1.2)
        return
    _axes(view, "", "percent of its mean")
    parts = {term: 100 * made.sensor_maps(state, term)[sensor].ravel() / mean for term in TERMS}
    view.stackplot(
        angle, *parts.values(), labels=TERMS, colors=[COLOURS[term] for term in TERMS], linewidth=0
    )
    view.plot(angle, 100 * total / mean, color=INK, linewidth=1.2)
    view.set_ylim(0, 105 * total.max() / mean)
    view.tick_params(labelbottom=False)
    handles, labels = view.get_legend_handles_labels()
    view.legend(
        handles[::-1],
        labels[::-1],
        fontsize=7,
        ncols=len(TERMS),
        loc="lower right",
        bbox_to_anchor=(1.01, 0.99),
        frameon=False,
        columnspacing=0.9,
        handlelength=1.1,
    )
    alone = cell.add_subplot(grid[1, 0], sharex=view)
    _axes(alone, across, "glint alone")
    alone.fill_between(angle, parts["glint"], color=COLOURS["glint"], alpha=0.45, linewidth=0)
    alone.plot(angle, parts["glint"], color="#b06d12", linewidth=1.2)
    alone.set_ylim(0, 1.5 * parts["glint"].max() or 1.0)
    rise = rise_of_glint(angle, parts["glint"], 100 * total / mean - parts["glint"])
    if rise:
        _name_spike(alone, angle, parts["glint"], rise)


def _name_spike(view, angle, glint, rise):
    """What the glint adds at its highest place, and how wide it is there."""
    at = int(np.argmax(glint))
    far = (angle[at] - angle[0]) / (angle[-1] - angle[0])
    wide = "" if rise["fwhm_deg"] is None else ", %.1f deg wide" % rise["fwhm_deg"]
    view.plot(angle[at], glint[at], "o", color=MARK, markersize=4, clip_on=False, zorder=5)
    view.text(
        angle[at],
        1.12 * glint[at],
        "%+.0f %% of the rest at %.1f deg%s" % (rise["percent"] or np.inf, rise["peak_deg"], wide),
        fontsize=7.5,
        color=MARK,
        ha="left" if far < 0.25 else "right" if far > 0.75 else "center",
        va="bottom",
    )


def _axes(view, across, up):
    view.set_xlabel(across, fontsize=8, color=INK)
    view.set_ylabel(up, fontsize=8, color=INK)
    view.tick_params(labelsize=7, color=FAINT)
    for spine in view.spines.values():
        spine.set_color(FAINT)
