# SPDX-License-Identifier: Apache-2.0
"""Pictures of response maps. Needs matplotlib (an optional extra)."""

import numpy as np

from .simulate import PUPIL_NOMINAL_MM, ResponseMap, as_headset

PANEL_HALF_DEG = 20.0
PANEL_STEP_DEG = 0.25


def sensor_maps(
    path,
    headset,
    pupil_mm=PUPIL_NOMINAL_MM,
    lid_opening=1.0,
    half_deg=PANEL_HALF_DEG,
    step_deg=PANEL_STEP_DEG,
):
    """What each sensor collects with its emitters lit: (degrees [n], response [sensor, el, az]).

    path, headset   of a map file, and the Headset that it was made of
    """
    degrees = np.arange(-half_deg, half_deg + step_deg / 2, step_deg)
    elevation, azimuth = np.meshgrid(degrees, degrees, indexing="ij")
    states = np.column_stack(
        [
            azimuth.ravel(),
            elevation.ravel(),
            np.full(azimuth.size, pupil_mm),
            np.full(azimuth.size, lid_opening),
        ]
    )
    with ResponseMap(path) as opened:
        response = headset.collect(opened.evaluate(states))
    return degrees, response.T.reshape(-1, len(degrees), len(degrees))


def draw_maps(figure, path, headset):
    """Draw every sensor's map and where the sensors are into a matplotlib figure or subfigure.

    headset   Headset, or path of its file
    """
    headset = as_headset(headset)
    degrees, maps = sensor_maps(path, headset)
    count = len(maps)
    columns = 4 if count > 3 else count + 1
    rows = -(-(count + 1) // columns)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[count + 1 :]:
        panel.set_axis_off()
    for k, panel in enumerate(panels[:count]):
        image = panel.imshow(
            maps[k] / maps[k].mean(),
            origin="lower",
            extent=(degrees[0], degrees[-1]) * 2,
            cmap="magma",
            interpolation="nearest",
        )
        panel.contour(
            degrees, degrees, maps[k] / maps[k].mean(), 9, colors="white", linewidths=0.4, alpha=0.6
        )
        panel.set_title("sensor %d" % k, fontsize=10)
        panel.set_xlabel("azimuth (deg, + temporal)", fontsize=8)
        panel.set_ylabel("elevation (deg)", fontsize=8)
        panel.tick_params(labelsize=7)
        bar = figure.colorbar(image, ax=panel, fraction=0.046, pad=0.03)
        bar.ax.tick_params(labelsize=7)
        bar.set_label("signal / mean", fontsize=7)
    _draw_placement(panels[count], headset)


def _draw_placement(panel, headset):
    """Front view of the headset: the eye, each sensor, and the point that it looks at."""
    turn = np.linspace(0, 2 * np.pi, 100)
    for radius, style in ((12.0, ":"), (5.85, "-"), (1.75, "-")):
        panel.plot(radius * np.cos(turn), radius * np.sin(turn), style, color="gray", linewidth=0.8)
    for k, port in enumerate(headset.sensors):
        x, y, z = port.position_mm
        reach = (-11.0 - z) / port.aim[2] if abs(port.aim[2]) > 1e-9 else 0.0
        colour = "C%d" % (k % 10)
        panel.annotate(
            "",
            xytext=(x, y),
            xy=(x + reach * port.aim[0], y + reach * port.aim[1]),
            arrowprops=dict(arrowstyle="->", color=colour, linewidth=0.9),
        )
        panel.plot(x, y, "o", color=colour, markersize=7)
        panel.annotate(str(k), (x, y), textcoords="offset points", xytext=(6, 4), fontsize=8)
    panel.set_aspect("equal")
    panel.set_title("placement, seen from the eye", fontsize=10)
    panel.set_xlabel("x (mm, + temporal)", fontsize=8)
    panel.set_ylabel("y (mm, + up)", fontsize=8)
    panel.tick_params(labelsize=7)


def save_maps(path, headset, picture, title=None):
    """Write the picture of a map file (format by its extension). ImportError when matplotlib is missing."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    headset = as_headset(headset)
    rows = -(-(len(headset.sensors) + 1) // 4)
    figure = Figure(figsize=(15, 3.6 * rows + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title or "%s: response over gaze, simulated person" % headset.name)
    draw_maps(figure, path, headset)
    figure.savefig(picture, dpi=110)
    return picture
