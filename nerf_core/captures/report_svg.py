"""The drawings of a capture report as SVG: cameras in plan and elevation, directions covered, photos in a row."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape

import numpy as np

from nerf_core.captures.report_records import CaptureReport, PhotoFacts
from nerf_core.captures.report_views import CELL, FAR_DEGREES

SIZE, MARGIN = 380, 26  # pixels of a drawing, and of its border
MOST_POINTS = 1500  # sparse points of a drawing: 40 kB
RIM = -30.0  # least elevation at the rim of the disc; lower where photos are
LEGS = 0.05  # of the drawing: how long the sides of a camera's frustum are
SIDE_NAMES = ("front", "right", "behind", "left")


def plan(report: CaptureReport) -> str:
    """Draw the cameras from above, the front below."""
    return _map(report, (0, 1), "Plan, from above", ("left", "right", "behind", "front"))


def elevation(report: CaptureReport) -> str:
    """Draw the cameras from the front, up above."""
    return _map(report, (0, 2), "Elevation, from the front", ("left", "right", "up", "down"))


def _map(report: CaptureReport, across: tuple[int, int], title: str, ends: tuple[str, str, str, str]) -> str:
    places = np.array([p.position for p in report.photos])[:, across]
    content = report.points[:, across] if len(report.points) else np.zeros((0, 2))
    content = content[:: max(1, -(-len(content) // MOST_POINTS))]
    low, high = np.minimum(places.min(0), 0), np.maximum(places.max(0), 0)
    if len(content):  # outliers of a sparse model must not shrink the cameras
        low = np.minimum(low, np.percentile(content, 15, axis=0))
        high = np.maximum(high, np.percentile(content, 85, axis=0))
    middle, side = (low + high) / 2, 1.12 * max(float((high - low).max()), 1e-9)
    scale = (SIZE - 2 * MARGIN) / side

    def at(xy: np.ndarray) -> tuple[float, float]:
        return SIZE / 2 + float(xy[0] - middle[0]) * scale, SIZE / 2 - float(xy[1] - middle[1]) * scale

    inside = (np.abs(content - middle) <= side / 2).all(1)
    parts = [f'<circle class="pt" cx="{x:.1f}" cy="{y:.1f}" r="1"/>' for x, y in map(at, content[inside])]
    x, y = at(np.zeros(2))
    if report.kind not in ("forward-facing", "single"):
        parts.append(f'<path class="ax" d="M{x - 6:.1f} {y:.1f}H{x + 6:.1f}M{x:.1f} {y - 6:.1f}V{y + 6:.1f}"/>')
    # odd ones lie on top
    parts += [_camera(p, at, across) for p in sorted(report.photos, key=lambda p: bool(p.odd))]
    w, e, n, s = (escape(end) for end in ends)
    parts.append(
        f'<text x="4" y="{SIZE / 2}">{w}</text><text x="{SIZE - 4}" y="{SIZE / 2}" class="r">{e}</text>'
        f'<text x="{SIZE / 2}" y="13" class="m">{n}</text><text x="{SIZE / 2}" y="{SIZE - 5}" class="m">{s}</text>'
    )
    parts.append(_scale_bar(report, scale))
    return _svg(title, SIZE, SIZE, parts)


def _camera(p: PhotoFacts, at: Callable[[np.ndarray], tuple[float, float]], across: tuple[int, int]) -> str:
    """A dot where a camera stands, and the sides of its frustum as they lie in the drawing."""
    x, y = at(p.position[list(across)])
    toward = p.forward[list(across)]
    half, leg = math.radians(p.field_of_view / 2), LEGS * SIZE * float(np.linalg.norm(toward))
    angle = math.atan2(-toward[1], toward[0])
    ends = [(x + leg * math.cos(angle + turn), y + leg * math.sin(angle + turn)) for turn in (-half, half)]
    lines = "L".join(f"{a:.1f} {b:.1f}" for a, b in (ends[0], (x, y), ends[1]))
    kind = "odd" if p.odd else "cam" if p.split in ("train", "") else "held"
    return (
        f'<g class="{kind}"><title>{_about(p)}</title><path d="M{lines}"/><circle cx="{x:.1f}" cy="{y:.1f}" r="3"/></g>'
    )


def _about(p: PhotoFacts) -> str:
    return escape("; ".join((p.name, *p.odd)))


def _scale_bar(report: CaptureReport, scale: float) -> str:
    """A bar of a round length, about a quarter of the drawing, in scene units and in those of the input."""
    wanted = SIZE / 4 / scale
    power = 10.0 ** math.floor(math.log10(wanted))
    length = max(n * power for n in (1, 2, 5) if n * power <= wanted)
    input_units = length * report.units_to_input
    text = f"{length:g} units" + (
        f" = {input_units:.3g} in the files' units" if abs(input_units / length - 1) > 1e-6 else ""
    )
    left, bottom = 8, SIZE - 20
    return (
        f'<path class="ax" d="M{left} {bottom}h{length * scale:.1f}"/><text x="{left}" y="{bottom - 4}">{text}</text>'
    )


# ---- directions -------------------------------------------------------------------------------------------------


def disc(report: CaptureReport) -> str:
    """Draw the directions from which the centre was photographed, in Lambert's azimuthal equal-area projection.

    Straight above is in the middle, r = 2 sin(polar angle / 2), and the front is below. Shaded: directions with no
    photo within FAR_DEGREES.
    """
    lowest = min([RIM, *(p.elevation - 5 for p in report.photos)])
    radius = (SIZE - 2 * MARGIN) / 2
    rim = math.sin(math.radians(90 - lowest) / 2)

    def at(azimuth: float, height: float) -> tuple[float, float]:
        r = radius * math.sin(math.radians(90 - height) / 2) / rim
        a = math.radians(azimuth)
        return SIZE / 2 + r * math.sin(a), SIZE / 2 + r * math.cos(a)

    parts = [f'<circle class="rim" cx="{SIZE / 2}" cy="{SIZE / 2}" r="{radius}"/>']
    parts += _cells(report, at)
    for height in (0, 30, 60):
        x, y = at(90, height)
        parts.append(f'<circle class="grid" cx="{SIZE / 2}" cy="{SIZE / 2}" r="{x - SIZE / 2:.1f}"/>')
        x, y = at(45, height)
        parts.append(f'<text x="{x + 2:.1f}" y="{y:.1f}">{height}°</text>')
    for k, name in enumerate(SIDE_NAMES):
        x, y = (
            SIZE / 2 + (radius + 10) * math.sin(k * math.pi / 2),
            SIZE / 2 + (radius + 10) * math.cos(k * math.pi / 2),
        )
        turn = f' transform="rotate({-90 if k == 3 else 90} {x:.1f} {y:.1f})"' if k % 2 else ""
        parts.append(f'<text class="m" x="{x:.1f}" y="{y + 4:.1f}"{turn}>{name}</text>')
    for p in sorted(report.photos, key=lambda p: bool(p.odd)):
        x, y = at(p.azimuth, p.elevation)
        kind = "odd" if p.odd else "cam" if p.split in ("train", "") else "held"
        parts.append(f'<g class="{kind}"><title>{_about(p)}</title><circle cx="{x:.1f}" cy="{y:.1f}" r="3"/></g>')
    return _svg(f"Directions photographed; shaded: none within {FAR_DEGREES:.0f}°", SIZE, SIZE, parts)


def _cells(report: CaptureReport, at: Callable[[float, float], tuple[float, float]]) -> list[str]:
    parts = []
    heights = report.heights
    step = float(heights[1] - heights[0]) if len(heights) > 1 else 2 * CELL
    for a, e in np.argwhere(report.uncovered):
        azimuth, height = float(report.azimuths[a]), float(heights[e])
        low, high = height - step / 2, min(height + step / 2, 90.0)
        corners = [(azimuth + dx * CELL / 2, h) for dx, h in ((-1, low), (1, low), (1, high), (-1, high))]
        parts.append("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in (at(*c) for c in corners)) + "Z")
    return [f'<path class="gap" d="{"".join(parts)}"/>'] if parts else []


# ---- photos in a row --------------------------------------------------------------------------------------------


def row(report: CaptureReport, values: Sequence[float], title: str, marks: Sequence[tuple[float, str]]) -> str:
    """Draw a number of each photo as a dot, in their order. marks: heights with a line and a name."""
    wide, high, left = 2 * SIZE, 150, 46
    known = np.array([v for v in values if math.isfinite(v)] + [v for v, _ in marks])
    low, top = float(known.min()), float(known.max())
    room = max(top - low, 1e-6)
    count = max(len(values) - 1, 1)

    def y(value: float) -> float:
        return high - 16 - (value - low) / room * (high - 36)

    parts = []
    for value, name in marks:
        parts.append(f'<path class="grid" d="M{left} {y(value):.1f}H{wide - 6}"/>')
        parts.append(f'<text class="r" x="{left - 5}" y="{y(value) + 4:.1f}">{escape(name)}</text>')
    for k, (value, p) in enumerate(zip(values, report.photos, strict=True)):
        if not math.isfinite(value):
            continue
        x = left + 6 + k / count * (wide - left - 18)
        kind = "odd" if p.odd else "cam" if p.split in ("train", "") else "held"
        dot = f'<circle cx="{x:.1f}" cy="{y(value):.1f}" r="3"/>'
        parts.append(f'<g class="{kind}"><title>{_about(p)}</title>{dot}</g>')
    return _svg(title, wide, high, parts)


def _svg(title: str, wide: int, high: int, parts: Sequence[str]) -> str:
    body = "".join(parts)
    return (
        f'<figure><svg viewBox="0 0 {wide} {high}" role="img" aria-label="{escape(title)}">{body}</svg>'
        f"<figcaption>{escape(title)}</figcaption></figure>"
    )
