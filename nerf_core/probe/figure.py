"""An opened pixel as a figure for a page: weights, light, density and colours over t, and the radiance's disc."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from nerf_core.probe.evidence import unseen
from nerf_core.probe.opened import Opened
from nerf_core.probe.radiance import disc_grid
from nerf_core.probe.ray import PassProbe

FINE, COARSE, LIGHT, ALPHA, DENSITY = "#0072b2", "#e69f00", "#cc79a7", "#56b4e9", "#009e73"  # Okabe and Ito's
WIDTH, HEIGHT = 7.0, 3.7  # inches: a column of text, and a ray
DOTS = 200  # an inch


def figure(opened: Sequence[Opened], kind: str) -> bytes:
    """PNG or SVG; a row for each ray."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(
        {
            "font.size": 8,
            "svg.fonttype": "none",
            "axes.spines.top": False,
            "axes.spines.right": False,
            "svg.hashsalt": "ray",
            "hatch.linewidth": 0.5,
            "hatch.color": "#777777",
        }
    ):
        page = Figure(figsize=(WIDTH, HEIGHT * len(opened)), dpi=DOTS)
        FigureCanvasAgg(page)
        for k, one in enumerate(opened):
            _draw(_Row(page, k, len(opened)), one)
        data = io.BytesIO()
        page.savefig(data, format=kind, metadata={"Date": None} if kind == "svg" else None)
    return data.getvalue()


class _Row:
    """A ray's part of the page: axes are placed by shares of it, so that every figure's lie alike."""

    def __init__(self, page: Any, k: int, count: int) -> None:
        self._page, self._bottom, self._height = page, 1 - (k + 1) / count, 1 / count

    def axes(self, left: float, bottom: float, width: float, height: float, **given: Any) -> Any:
        at = (left, self._bottom + bottom * self._height, width, height * self._height)
        return self._page.add_axes(at, **given)

    def title(self, text: str, under: str) -> None:
        left = {"ha": "left", "va": "top", "parse_math": False}
        self._page.text(0.02, self._bottom + 0.985 * self._height, text, fontsize=9, **left)
        self._page.text(0.02, self._bottom + 0.93 * self._height, under, fontsize=6.5, color="0.3", **left)


def _draw(row: _Row, one: Opened) -> None:
    ray = one.ray
    top = row.axes(0.1, 0.51, 0.58, 0.29)
    middle, strip = row.axes(0.1, 0.22, 0.58, 0.25, sharex=top), row.axes(0.1, 0.145, 0.58, 0.04, sharex=top)
    for axes in (top, middle):
        axes.tick_params(labelbottom=False)
    passes = [_finite(p) for p in ray.passes]
    last = passes[-1]
    for p in passes:
        if not len(p.t):
            continue
        color = FINE if p is last else COARSE
        t, until = _stretches(p, ray.far)
        peak = float(p.weights.max()) or 1.0  # a pass's own: many narrow samples share what a few wide ones have
        if p is last:
            top.bar(t, p.weights / peak, until - t, align="edge", color=color, alpha=0.35, lw=0)
        for axes, values, tint in ((top, p.weights / peak, color), (middle, p.sigma, DENSITY if p is last else COARSE)):
            x, y = _steps(t, until, values)
            label = f"{p.name} w / {peak:.2g}" if axes is top else None
            axes.plot(x, y, color=tint, lw=1.0, label=label)
    t, until = _stretches(last, ray.far)
    if len(t):
        top.plot(*_steps(t, until, last.alpha), color=ALPHA, lw=0.7, label="α")
    left_over = last.transmittance[-1:] * (1 - last.alpha[-1:])
    light = np.concatenate([[1.0], last.transmittance, left_over if len(t) else [1.0]])
    top.plot(np.concatenate([[ray.near], t, [max([ray.far, *t[-1:]])]]), light, color=LIGHT, lw=1.2, label="T")
    strip.bar(t, 1, until - t, align="edge", color=np.clip(last.rgb, 0, 1), lw=0)
    for name, mark in (("expected", "v"), ("median", "D"), ("strongest", "o")):
        depth = getattr(ray, f"depth_{name}")
        if depth is not None:
            top.plot([depth], [1.06], mark, color="black", ms=3.5, fillstyle="none", clip_on=False, label=name)
    top.set(ylim=(0, 1.1), ylabel="w / largest, T, α", xlim=(ray.near, max(ray.far, ray.near + 1e-6)))
    top.legend(frameon=False, fontsize=6, loc="lower left", ncols=8, bbox_to_anchor=(-0.02, 1.03), borderaxespad=0,
               columnspacing=1.2, handlelength=1.5)  # fmt: skip
    middle.set(ylabel="σ (1/unit)" if one.scene.ndc is None else "σ (1/NDC unit)")
    middle.set_ylim(bottom=0)
    strip.set(yticks=[], xlabel="t (world units)", ylabel="colour")
    strip.yaxis.label.set(rotation=0, ha="right", va="center")
    row.title(*_words(one))
    _draw_disc(row.axes(0.735, 0.22, 0.25, 0.58), one)


def _words(one: Opened) -> tuple[str, str]:
    """What it is, and why."""
    (x, y), camera = one.ray.pixel, one.camera
    what = f"pixel {x}, {y} of {camera.width} × {camera.height}"
    about = ", ".join(filter(None, (one.scene.name, one.method, f"step {one.ray.step:,}")))
    verdict = one.verdict
    title = ": ".join(filter(None, (one.name, verdict.kind if verdict is not None else "")))
    reasons = "; ".join(verdict.reasons) if verdict is not None else ""
    return f"{title or 'a ray'}  —  {what}, {about}", textwrap.fill(reasons, 150, max_lines=2, placeholder=" …")


def _finite(p: PassProbe) -> PassProbe:
    """Zero for what is not a number: a figure of a broken ray shows that much."""
    arrays = {f.name: getattr(p, f.name) for f in fields(p) if f.name not in ("name", "until")}
    return replace(p, **{name: np.nan_to_num(value.astype(np.float64)) for name, value in arrays.items()})


def _stretches(p: PassProbe, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the samples' stretches begin and end; a last one without end goes on to the far bound."""
    t = p.t.astype(np.float64)
    if not len(t):
        return t, t
    return t, np.clip(p.until.astype(np.float64), t, np.append(t[1:], max(far, t[-1])))


def _steps(t: np.ndarray, until: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line that is `values` over each stretch, and 0 between two that do not touch."""
    x = np.stack([t, t, until, until], 1).ravel()
    touches = np.append(t[1:] - until[:-1] <= 1e-3 * (until - t)[:-1], False)
    after = np.where(touches, np.append(values[1:], 0), 0)
    before = np.concatenate([[0.0], np.where(touches[:-1], values[:-1], 0)])
    return x, np.stack([before, values, values, after], 1).ravel()


def _draw_disc(axes: Any, one: Opened) -> None:
    axes.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), xticks=[], yticks=[], aspect="equal", frame_on=False)
    radiance = one.radiance
    if radiance is None:
        return
    axes.imshow(radiance.disc_image(), extent=(-1, 1, -1, 1), interpolation="bilinear")
    angle = np.linspace(0, 2 * np.pi, 200)
    axes.plot(np.cos(angle), np.sin(angle), color="black", lw=0.6)
    x, y, inside = disc_grid()
    far = np.zeros(inside.shape)
    far[inside] = unseen(radiance.directions[-int(inside.sum()) :], one.evidence)
    if far.any():
        axes.contourf(x, y, far, levels=[0.5, 1.5], colors="none", hatches=["/////"])
    if one.evidence is not None:
        seen = one.evidence.directions[one.evidence.seen]
        places = radiance.disc_position(seen)  # NaN is not drawn
        axes.plot(places[:, 0], places[:, 1], "o", ms=2.5, mfc="white", mec="black", mew=0.5)
    axes.plot(*radiance.disc_position(-one.ray.direction), "+", color="black", ms=7, mew=1)
    axes.set_title(f"radiance at t = {radiance.t:.3g}", fontsize=8)
    note = "\nhatched: no photo looked from there" if far.any() else ""
    axes.set_xlabel(f"view-dependence {radiance.dependence:.3f}{note}", fontsize=7)
