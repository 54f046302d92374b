# SPDX-License-Identifier: Apache-2.0
"""The picture of a View: what a sensor sees, what of it is summed, and by which parts.

Needs matplotlib (the optional extra `pictures`). Perspective is the sensor's own: equal lengths are equal
tangents of the angle off its axis, and the axes say how many degrees that is. Tone: below ToneCurve.
"""

import os
import tempfile

import numpy as np

from .mapfigure import COLOURS, FAINT, INK, picture_kind

_DPI = 130
_CIRCLES = (1, 2)
_PAPER, _CYAN = "white", "#5fd0ff"


class ToneCurve:
    """Radiance L to brightness 0..1 and back: ((L / (L + m)) * (M + m) / M) ^ (1 / 2.2), where m is the mean
    of the pixels that show something and M the brightest: linear for the dim, saturating for glints, and M
    is white (Reinhard's curve with a white point, then the usual gamma of a screen).
    """

    GAMMA = 2.2

    def __init__(self, image):
        lit = image[image > 0]
        self.mean = float(lit.mean()) if lit.size else 1.0
        self.most = float(lit.max()) if lit.size else 1.0

    def forward(self, value):
        """Brightness of radiances."""
        value = np.maximum(np.asarray(value, float), 0)
        return (value / (value + self.mean) * (self.most + self.mean) / self.most) ** (1 / self.GAMMA)

    def inverse(self, brightness):
        """Radiances of brightnesses."""
        z = np.clip(np.asarray(brightness, float), 0, 1) ** self.GAMMA * self.most / (self.most + self.mean)
        return self.mean * z / (1 - z)

    def ticks(self):
        """A handful of round radiances that are spread over the brightnesses."""
        top = np.floor(np.log10(self.most))
        steps = [k * 10.0**power for power in np.arange(top - 3, top + 1) for k in (1, 2, 5)]
        chosen, last = [0.0], 0.0
        for value in steps:
            at = float(self.forward(value))
            if value <= self.most and at - last > 0.09:
                chosen.append(value)
                last = at
        return chosen


def save_view(seen, path, headset_name="", person_name="simulated person"):
    """Write the picture of a View (format by the file name's end), complete or not at all."""
    kind = picture_kind(path)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.2, 8.3), facecolor=_PAPER)
    FigureCanvasAgg(figure)
    draw_view(figure, seen, headset_name, person_name)
    write_whole(path, lambda temporary: figure.savefig(temporary, dpi=_DPI, format=kind, facecolor=_PAPER))
    return path


def write_whole(path, write):
    """Call write(temporary file) and put what it wrote in the place of `path` at one stroke."""
    path = os.fspath(path)
    handle, temporary = tempfile.mkstemp(".part", ".", os.path.dirname(path) or ".")
    os.close(handle)
    try:
        write(temporary)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def draw_view(figure, seen, headset_name="", person_name="simulated person"):
    """Draw a View into a matplotlib figure of 13.2 x 8.3 inches."""
    image = seen.radiance.sum(0)
    _draw_picture(figure, [0.055, 0.14, 0.4614, 0.7338], seen, image)
    _draw_summed(figure, [0.642, 0.418, 0.275, 0.4373], seen, image)
    _draw_parts(figure.add_axes([0.642, 0.185, 0.275, 0.062]), seen)
    name = headset_name + ": what" if headset_name else "What"
    title = "%s sensor %d sees" % (name, seen.sensor)
    figure.text(0.055, 0.962, title, fontsize=17, color=INK, weight="bold", va="center")
    figure.text(0.055, 0.918, _state(seen, person_name), fontsize=11, color=INK, va="center")
    figure.text(0.055, 0.02, _caption(seen), fontsize=8.8, color="#55616b", linespacing=1.5)


def _state(seen, person_name):
    lit = ", ".join(str(e) for e in seen.emitters)
    return (
        "%s, gaze %g° azimuth %g° elevation, pupil %g mm, lids %g %% open;  lit: emitter%s %s"
        % (
            person_name,
            seen.azimuth_deg,
            seen.elevation_deg,
            seen.pupil_mm,
            100 * seen.lid_opening,
            "" if len(seen.emitters) == 1 else "s",
            lit,
        )
    ).replace("-", "−")


def _caption(seen):
    return (
        "Left: near-infrared radiance, as a pinhole at the sensor sees it; brightness = (L/(L+m) · "
        "(M+m)/M)$^{1/2.2}$, m the mean of what is lit, M the brightest. Ringed: each emitter's glint.\n"
        "Right: the same times the sensor's Gaussian window and each pixel's solid angle; its sum is the "
        "signal. "
        "%d × %d pixels, %s, linear floats, one reflection."
        % (*seen.window.shape, {"embree": "Embree (float64)", "osmesa": "OSMesa (float32)"}[seen.renderer])
    )


def _frame(axes, seen):
    """Ticks in degrees on axes of tangents; circles of the window."""
    half = seen.edges[-1]
    widest = np.degrees(np.arctan(half))
    step = next(s for s in (0.5, 1, 2, 5, 10, 20, 30) if widest / s <= 5 or s == 30)
    degrees = np.arange(-np.floor(widest / step), np.floor(widest / step) + 1) * step
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(np.tan(np.radians(degrees)), [("%g" % d).replace("-", "−") for d in degrees])
    axes.tick_params(labelsize=8.5, colors=INK, length=3)
    for side in axes.spines.values():
        side.set_color(FAINT)
    axes.set_xlim(-half, half)
    axes.set_ylim(-half, half)
    return half


def _circles(axes, seen, colour, labels):
    from matplotlib.patches import Circle

    sigma = seen.sigma_tan
    for k in _CIRCLES:
        drawn = dict(color=colour, lw=0.9, ls=(0, (5, 4)), alpha=0.85)
        axes.add_patch(Circle((0, 0), k * sigma, fill=False, **drawn))
        if labels:
            turn = np.radians(135)
            axes.annotate(
                "%dσ: %.0f %%" % (k, 100 * np.exp(-k * k / 2)),
                (k * sigma * np.cos(turn), k * sigma * np.sin(turn)),
                xytext=(-3, 2),
                textcoords="offset points",
                color=colour,
                fontsize=9,
                ha="right",
                va="bottom",
                path_effects=_outlined(),
            )
    axes.plot(0, 0, "+", color=colour, ms=8, mew=0.9, alpha=0.85)


def _outlined():
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=2.2, foreground="black", alpha=0.6)]


def _extent(seen):
    return (seen.edges[0], seen.edges[-1]) * 2


def _bar(figure, drawn, place, label):
    """A colour bar at the right of a panel's place [left, bottom, width, height]."""
    left, bottom, width, height = place
    bar = figure.colorbar(drawn, cax=figure.add_axes([left + width + 0.009, bottom, 0.012, height]))
    bar.ax.tick_params(labelsize=8.5, colors=INK, length=3)
    bar.outline.set_edgecolor(FAINT)
    bar.set_label(label, fontsize=9.5, color=INK)
    return bar


def _draw_picture(figure, place, seen, image):
    from matplotlib.colors import FuncNorm

    axes, tone = figure.add_axes(place), ToneCurve(image)
    norm = FuncNorm((tone.forward, tone.inverse), vmin=0, vmax=tone.most)
    drawn = axes.imshow(image, cmap="gray", norm=norm, extent=_extent(seen), interpolation="bilinear")
    _frame(axes, seen)
    _circles(axes, seen, _CYAN, labels=True)
    for number, at in seen.glints():
        axes.plot(*at, "o", ms=24, mfc="none", mec=COLOURS["glint"], mew=1.2)
        axes.annotate(
            str(number),
            at,
            xytext=(11, 8),
            textcoords="offset points",
            color=COLOURS["glint"],
            fontsize=11,
            weight="bold",
            path_effects=_outlined(),
        )
    axes.set_xlabel("temple  ←   degrees from the sensor's axis   →  nose", fontsize=9.5, color=INK)
    axes.set_ylabel("degrees from the sensor's axis  →  up", fontsize=9.5, color=INK)
    power = int(np.floor(np.log10(tone.most)))
    bar = _bar(
        figure,
        drawn,
        place,
        "radiance L per axial intensity of each emitter  (10$^{%s}$ mm$^{-2}$)" % _signed(power),
    )
    ticks = tone.ticks()
    bar.set_ticks(ticks, labels=["%g" % round(v / 10.0**power, 6) for v in ticks])
    bar.ax.minorticks_off()


def _signed(number):
    return str(number).replace("-", "−")


def _draw_summed(figure, place, seen, image):
    from matplotlib.colors import PowerNorm

    axes = figure.add_axes(place)
    weighed = image * seen.window
    total = (weighed * seen.solid_angle).sum()
    share = 100 * weighed / (total or 1) * np.radians(1) ** 2
    drawn = axes.imshow(
        share,
        cmap="inferno",
        norm=PowerNorm(0.5, vmin=0, vmax=share.max() or 1),
        extent=_extent(seen),
        interpolation="bilinear",
    )
    _frame(axes, seen)
    _circles(axes, seen, _CYAN, labels=False)
    axes.set_title("times the window: what is summed", fontsize=10.5, color=INK, loc="left")
    _bar(figure, drawn, place, "% of the signal per square degree")


def _draw_parts(axes, seen):
    sums = {name: float(value.sum()) for name, value in seen.sums().items()}
    total = sums.pop("total")
    mantissa, power = ("%.3e" % total).split("e")
    axes.set_title(
        "signal %s · 10$^{%s}$ mm$^{-2}$" % (mantissa, _signed(int(power))),
        fontsize=10.5,
        color=INK,
        loc="left",
        pad=22,
    )
    left = 0.0
    for at, (name, value) in zip((0.0, 0.235, 0.505, 0.745), sums.items()):
        share = 100 * value / total if total else 0.0
        axes.barh(0, share, left=left, height=1, color=COLOURS[name], edgecolor=_PAPER, linewidth=1.5)
        left += share
        text = dict(transform=axes.transAxes, va="center", ha="left")
        axes.text(at, 1.22, "■", color=COLOURS[name], fontsize=11, **text)
        axes.text(at + 0.038, 1.22, "%s %.1f %%" % (name, share), color=INK, fontsize=9, **text)
    axes.set_xlim(0, 100)
    axes.set_ylim(-0.5, 0.5)
    axes.set_yticks([])
    axes.set_xticks([0, 25, 50, 75, 100], ["0", "25", "50", "75", "100 %"])
    axes.tick_params(labelsize=8, colors=INK, length=2)
    for side in axes.spines.values():
        side.set_visible(False)
