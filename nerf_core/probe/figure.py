"""Draw opened pixels as a figure for a page.

It has weights, transmittance, density and colours over t, and the radiance as a disc.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np

from nerf_core.probe.axis import MET, PLAIN, Axis, AxisChoice, chosen_axis, contracted_axis, weighty_part
from nerf_core.probe.bare_figure import draw_color, draw_visits
from nerf_core.probe.disc_figure import draw_disc
from nerf_core.probe.records import WITHOUT_SAMPLES, Opened, PassProbe
from nerf_core.probe.verdicts import NOTHING

FINE, COARSE, LIGHT, ALPHA, DENSITY = "#0072b2", "#e69f00", "#cc79a7", "#d55e00", "#009e73"  # Okabe and Ito's
WIDTH, HEIGHT = 7.0, 3.9  # inches: the width of a page's text, and the height of one ray
DOTS = 200  # per inch
LEFT = 0.02  # the margin of a ray's text on either side, as a share of the width

STYLE: dict[Any, Any] = {
    "font.size": 8,
    "svg.fonttype": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "ray",
    "hatch.linewidth": 0.4,
}


def figure(opened: Sequence[Opened], kind: str, choice: AxisChoice = "auto") -> bytes:
    """Return a figure as the bytes of a file, with one row for each ray.

    Args:
        opened: one or more opened pixels.
        kind: "png" or "svg".
        choice: of the axis over t; see `chosen_axis`.
    """
    import matplotlib as mpl

    data = io.BytesIO()
    with mpl.rc_context(STYLE):
        page(opened, choice).savefig(data, format=kind, metadata={"Date": None} if kind == "svg" else None)
    return data.getvalue()


def page(opened: Sequence[Opened], choice: AxisChoice = "auto") -> Any:
    """Return matplotlib's `Figure` with one row for each ray, WIDTH × HEIGHT inches each. Arguments: see `figure`."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        found = Figure(figsize=(WIDTH, HEIGHT * len(opened)), dpi=DOTS)
        FigureCanvasAgg(found)
        for k, one in enumerate(opened):
            _draw(_Row(found, k, len(opened)), one, choice)
    return found


class _Row:
    """One ray's part of the page. Axes are placed by shares of it, so that they lie alike in every figure."""

    def __init__(self, page: Any, k: int, count: int) -> None:
        self._page, self._bottom, self._height = page, 1 - (k + 1) / count, 1 / count

    def axes(self, left: float, bottom: float, width: float, height: float, **given: Any) -> Any:
        at = (left, self._bottom + bottom * self._height, width, height * self._height)
        return self._page.add_axes(at, **given)

    def strip(
        self, left: np.ndarray, right: np.ndarray, heights: np.ndarray, frame: np.ndarray, at: tuple[float, ...]
    ) -> None:
        """Draw bars over a line, and a frame. They lie at shares of the line; `at` is its place, as for `axes`."""
        from matplotlib.patches import Rectangle

        x, y, width, height = at[0], self._bottom + at[1] * self._height, at[2], at[3] * self._height
        ground = {"transform": self._page.transFigure, "lw": 0}
        self._page.add_artist(Rectangle((x, y), width, height, color="0.92", **ground))
        for a, b, share in zip(left, right, heights, strict=True):
            if share > 0:
                wide = max((b - a) * width, 1e-3)
                self._page.add_artist(Rectangle((x + a * width, y), wide, share * height, color=FINE, **ground))
        low, high = (x + frame * width).tolist()
        ground |= {"lw": 0.7, "fill": False, "edgecolor": "black"}
        self._page.add_artist(Rectangle((low, y - 0.2 * height), max(high - low, 2e-3), 1.4 * height, **ground))

    def title(self, text: str, under: str) -> None:
        """Write a title and the text under it, four lines in all."""
        lines, below = self._write(text, 2, 0.98, fontsize=9)
        self._write(under, 4 - lines, below - 0.015, fontsize=6.5, color="0.3")

    def _write(self, text: str, lines: int, top: float, **given: Any) -> tuple[int, float]:
        """Write text in at most `lines` lines and cut the last one short if it does not fit.

        Returns the number of lines, and their lower end as a share of the row's height.
        """
        top = self._bottom + top * self._height
        found = self._page.text(LEFT, top, text, ha="left", va="top", parse_math=False, **given)
        room = (1 - 2 * LEFT) * self._page.bbox.width
        letters = int(2 * len(text) * min(1.0, room / max(found.get_window_extent().width, 1.0)))  # more than fit
        while True:
            found.set_text(textwrap.fill(text, letters, max_lines=lines, placeholder=" …"))
            box = found.get_window_extent()
            if box.width <= room or letters == 1:
                break
            letters -= 1
        below = (box.y0 / self._page.bbox.height - self._bottom) / self._height
        return found.get_text().count("\n") + 1, below


class _Axes(NamedTuple):
    """A ray's axes over t, from the top: depth marks; weights, α and T; density; colours."""

    marks: Any
    weights: Any
    density: Any
    strip: Any


def _draw(row: _Row, one: Opened, choice: AxisChoice) -> None:
    """Draw an opened ray into its row."""
    if not one.ray.passes:
        row.title(*_words(one))
        draw_visits(row.axes(0.125, 0.145, 0.555, 0.545), one.ray)
        draw_color(row.axes(0.73, 0.215, 0.25, 0.5), one.ray)
        return
    weights = row.axes(0.125, 0.44, 0.555, 0.25)
    marks, density, strip = (row.axes(0.125, at, 0.555, height, sharex=weights)
                             for at, height in ((0.7, 0.085), (0.21, 0.2), (0.145, 0.038)))  # fmt: skip
    axes = _Axes(marks, weights, density, strip)
    for each in (weights, density):
        each.tick_params(labelbottom=False)
    passes = [_finite(p) for p in one.ray.passes]
    for p in passes:
        _draw_pass(axes, p, one.ray.far, last=p is passes[-1])
    _draw_last(axes, passes[-1], one)
    points = () if one.radiance is None else (one.radiance.t,)
    part = weighty_part(one.ray, tuple(passes), one.scene.radius, *points)
    axis = chosen_axis(one.ray, one.scene, choice, part)
    _draw_marks(marks, one, part)
    _draw_point(axes, one)
    _label(axes, passes, one, axis, part)
    if part[0] > one.ray.near or part[1] < one.ray.far:
        _draw_overview(row, one, contracted_axis(one.ray, one.scene) or PLAIN, passes[-1], part)
    row.title(*_words(one))
    draw_disc(row.axes(0.73, 0.215, 0.25, 0.5), one)


def _draw_pass(axes: _Axes, p: PassProbe, far: float, last: bool) -> None:
    """Draw the weights and the density of a pass; the area under the last pass's weights is filled."""
    if not len(p.t):
        return
    t, until = _stretches(p, far)
    # Each pass has its own scale, because many narrow samples share the weight of a few wide ones. A pass that hits
    # nothing is not scaled up.
    scale = float(p.weights.max()) if p.weights.sum() >= NOTHING else 1.0
    x, w = _steps(t, until, p.weights / scale)
    if last:
        axes.weights.fill_between(x, w, color=FINE, alpha=0.35, lw=0)
    color, tint = (FINE, DENSITY) if last else (COARSE, COARSE)
    axes.weights.plot(x, w, color=color, lw=1.0, label=f"{p.name} w" + (f" / {scale:.2g}" if scale != 1 else ""))
    axes.density.plot(*_steps(t, until, p.sigma), color=tint, lw=1.0)


def _draw_last(axes: _Axes, last: PassProbe, one: Opened) -> None:
    """Draw α, T and the colours of the last pass, which makes the pixel."""
    ray = one.ray
    t, until = _stretches(last, ray.far)
    if len(t):
        axes.weights.plot(*_steps(t, until, last.alpha), color=ALPHA, lw=0.8, ls=(0, (3, 1.2)), label="α")
    passed = np.stack([last.transmittance, last.transmittance * (1 - last.alpha)], 1).ravel()  # before, behind
    light = np.concatenate([[1.0], passed, passed[-1:] if len(t) else [1.0]])
    ends = np.concatenate([[ray.near], np.stack([t, until], 1).ravel(), [max([ray.far, *until[-1:]])]])
    axes.weights.plot(ends, light, color=LIGHT, lw=1.2, label="T")
    # Each bar extends under the next one if they touch; else the paper would shine through where two edges meet.
    under = np.where(_touching(t, until), until[1:], until[:-1])
    axes.strip.bar(t, 1, np.append(under, until[-1:]) - t, align="edge", color=np.clip(last.rgb, 0, 1), lw=0)
    if last.weights.sum() < NOTHING:
        known = np.isfinite(ray.last.weights).all()
        _say(axes.weights, "the ray met nothing" if known else "the ray's weights are not numbers")


def _draw_point(axes: _Axes, one: Opened) -> None:
    """Draw a line at the point whose radiance is shown."""
    if one.radiance is None:
        return
    axes.strip.axvline(one.radiance.t, color="white", lw=1.6)
    for each in (axes.weights, axes.density, axes.strip):
        each.axvline(one.radiance.t, color="black", lw=0.6, label="point" if each is axes.weights else None)


def _draw_overview(row: _Row, one: Opened, axis: Axis, last: PassProbe, part: tuple[float, float]) -> None:
    """Draw the whole ray as a thin strip under the axes: its weight, and a frame around the part that they show."""
    end = np.inf if axis.turn is not None else one.ray.far
    low, high = axis.place(np.array([one.ray.near, 1e30 if np.isinf(end) else end]))
    t, until = _stretches(last, one.ray.far)
    shares = [(axis.place(v) - low) / max(high - low, 1e-12) for v in (t, until, np.array(part))]
    left, right, frame = (np.clip(v, 0, 1) for v in shares)
    heights = last.weights / max(float(last.weights.max(initial=0)), 1e-12)
    row.strip(left, right, heights, frame, (0.125, 0.018, 0.555, 0.016))


def _label(axes: _Axes, passes: Sequence[PassProbe], one: Opened, axis: Axis, part: tuple[float, float]) -> None:
    """Set the limits, labels and the legend, once everything is drawn."""
    ray, (low, high) = one.ray, part
    if axis.turn is not None:
        axes.weights.set_xscale("function", functions=(axis.place, axis.distance))
        places, labels = axis.ticks(*axis.place(np.array(part)))
        ends = [(t, label) for t, label in zip(axis.distance(places).tolist(), labels, strict=True) if np.isfinite(t)]
        axes.weights.set_xticks([t for t, _ in ends], [label for _, label in ends])
        axes.weights.xaxis.minorticks_off()
    axes.weights.set(xlim=(low, high), ylim=(0, 1.1), ylabel="w / largest, T, α")
    axes.weights.legend(frameon=False, fontsize=6, loc="lower left", ncols=8, bbox_to_anchor=(0, 1.02),
                        borderaxespad=0, bbox_transform=axes.marks.transAxes, borderpad=0, columnspacing=1.5,
                        handlelength=2)  # fmt: skip
    axes.density.set(ylabel="σ (1/unit)" if one.scene.ndc is None else "σ (1/NDC unit)")
    axes.density.locator_params(axis="y", nbins=4)
    axes.density.set_ylim(0, 1.1 * max((_largest(p, ray.far, low, high) for p in passes), default=0.0) or 1.0)
    if not any(len(p.t) for p in passes):
        axes.density.set_yticks([])
        _say(axes.density, "no samples")
    whole = low <= ray.near and high >= ray.far
    extent = "" if whole else f", part of near {ray.near:.3g} … far {ray.far:.3g} (strip)"
    scale = "" if axis.turn is None else f", contracted from {axis.turn:.3g} on"
    axes.strip.set(yticks=[], ylim=(0, 1), xlabel=f"t (world units{scale}){extent}", ylabel="colour")
    axes.strip.yaxis.label.set(rotation=0, ha="right", va="center")
    axes.weights.get_figure().align_ylabels([axes.weights, axes.density])


def _say(axes: Any, text: str) -> None:
    paper = {"facecolor": "white", "edgecolor": "none", "pad": 3}
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color="0.3", bbox=paper)


def _largest(p: PassProbe, far: float, low: float, high: float) -> float:
    """Return the largest density of a pass between two world distances."""
    t, until = _stretches(p, far)
    return float(p.sigma[(until >= low) & (t <= high)].max(initial=0.0))


def _draw_marks(axes: Any, one: Opened, part: tuple[float, float]) -> None:
    """Draw the three depths, each in a row of its own, because on a clean surface they coincide.

    One that lies behind the drawn part is an arrow at its end, with the number.
    """
    met = " depth" if one.ray.opacity >= MET else f" of {one.ray.opacity:.0%}"
    marks = ((f"expected{met}", one.ray.depth_expected, "v"), ("median depth", one.ray.depth_median, "D"),
             ("strongest w", one.ray.depth_strongest, "o"))  # fmt: skip
    known = [(2 - k, *mark) for k, mark in enumerate(marks) if mark[1] is not None]
    axes.set(ylim=(-0.6, 2.6), yticks=[y for y, *_ in known], yticklabels=[name for _, name, *_ in known])
    axes.tick_params(axis="y", length=0, labelsize=6)
    axes.xaxis.set_visible(False)
    axes.spines[:].set_visible(False)
    if one.radiance is not None and known:
        axes.axvline(one.radiance.t, color="black", lw=0.6)
    for y, name, depth, mark in known:
        axes.axhline(y, color="0.85", lw=0.5, zorder=0)
        assert depth is not None
        inside = depth <= part[1]
        axes.plot([depth if inside else part[1]], [y], mark if inside else ">", color="black", mfc="white", ms=3.2,
                  mew=0.7, clip_on=False, label=name, zorder=3)  # fmt: skip
        if not inside:
            axes.annotate(f"{depth:.4g}", (part[1], y), (-5, 0), textcoords="offset points", ha="right", va="center",
                          fontsize=6)  # fmt: skip


def _words(one: Opened) -> tuple[str, str]:
    """Return the title, and the text that says what the pixel is and why. A user's name keeps its first letter."""
    (x, y), camera, verdict = one.ray.pixel, one.camera, one.verdict
    what = f"Pixel {x}, {y} of {camera.width} × {camera.height}"
    begins = f"t begins at {one.ray.near:.3g}, {one.ray.begins}" if one.ray.begins else ""
    about = ", ".join(filter(None, (what, one.scene.name, one.method, f"step {one.ray.step:,}", begins)))
    title = ": ".join(filter(None, (one.name, verdict.kind if verdict is not None else ""))) or "a ray"
    reasons = _sentence("; ".join(verdict.reasons)) if verdict is not None else ""
    if not one.ray.passes:
        reasons = _sentence(WITHOUT_SAMPLES)
    return title if one.name else _sentence(title), ". ".join(filter(None, (about, reasons)))


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _finite(p: PassProbe) -> PassProbe:
    """Replace what is not finite, so that the rest of a broken ray can be drawn. NaN becomes 0."""
    arrays = {f.name: getattr(p, f.name) for f in fields(p) if f.name not in ("name", "until")}
    return replace(p, **{name: np.nan_to_num(value.astype(np.float64)) for name, value in arrays.items()})


def _stretches(p: PassProbe, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where the samples' stretches begin and end (S,). An endless last one ends at the far bound."""
    t = p.t.astype(np.float64)
    if not len(t):
        return t, t
    return t, np.clip(p.until.astype(np.float64), t, np.append(t[1:], max(far, t[-1])))


def _touching(t: np.ndarray, until: np.ndarray) -> np.ndarray:
    """Return for each stretch but the last whether the next one begins where it ends, bool (S − 1,)."""
    return t[1:] - until[:-1] <= 1e-3 * (until - t)[:-1]


def _steps(t: np.ndarray, until: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a line that has `values` (S,) over the stretches and 0 in the gaps between them."""
    x = np.stack([t, t, until, until], 1).ravel()
    touches = np.append(_touching(t, until), False)
    after = np.where(touches, np.append(values[1:], 0), 0)
    before = np.concatenate([[0.0], np.where(touches[:-1], values[:-1], 0)])
    return x, np.stack([before, values, values, after], 1).ravel()
