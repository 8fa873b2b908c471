"""Draw lines and points in space over the viewport, with the camera's projection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from nerf_core.geometry.camera import Camera
from nerf_core.probe import RayProbe

from ..ui.widgets import packed, tints
from .visits import DISC_EM, Ink, discs

NEAR = 1e-3  # of the distance to the orbit's centre: lines nearer to the eye are cut off
FAINT = 1e-3  # a sample of smaller weight cannot change an 8-bit pixel and is not drawn
MOST_FRUSTA = 400  # of a capture's cameras: they are drawn in 5 ms; more would hide the picture
MANY = 300  # discs: comparing more of them pairwise would take longer than drawing them
TAG_PAD_EM = 0.3  # margin around a name
REACH_EM = 0.3  # the mouse still hits a sample at this distance from its rim


class Overlay:
    """Draws 3D figures for one camera into an imgui draw list.

    origin: the screen position of the viewport's top left pixel.
    near: the z-depth at which lines are cut.
    """

    def __init__(self, draw: imgui.ImDrawList, camera: Camera, origin: tuple[float, float], near: float) -> None:
        self._draw = draw
        self._camera = camera
        self._origin = np.asarray(origin, dtype=np.float64)
        self._near = near

    def lines(self, starts: np.ndarray, ends: np.ndarray, *strokes: tuple[ImVec4 | list[ImVec4], float]) -> None:
        """Draw segments between world points (N, 3) and (N, 3).

        strokes: each is a colour for all, or one per segment, and a thickness; they are drawn over each other.
        """
        a, b, visible = clip_segments(self._camera, starts, ends, self._near)
        index = np.flatnonzero(visible).tolist()
        a, b = a[index] + self._origin, b[index] + self._origin
        shown = [(ImVec2(*p), ImVec2(*q)) for p, q in zip(a, b, strict=True)]
        for color, thickness in strokes:
            tints = [packed(color[k]) for k in index] if isinstance(color, list) else [packed(color)] * len(index)
            for (p, q), tint in zip(shown, tints, strict=True):
                self._draw.add_line(p, q, tint, thickness)

    def samples(self, rays: Sequence[RayProbe], em: float, *rims: tuple[ImVec4 | Sequence[ImVec4], float]) -> None:
        """Draw the samples of the last passes as discs: the area grows with the weight, the colour is the sample's.

        All rims of a ray lie under all of its samples, because dense samples would otherwise hide each other's colours.

        Args:
            rays: drawn over each other in this order.
            em: the height of the font in pixels.
            rims: colours, each for all rays or one per ray, and the width of each in pixels.
        """
        if not rays:
            return
        found = self._discs(rays, em)
        fills = tints(np.concatenate([ray.last.rgb for ray in rays])[found.sample])
        places, radii, circle = found.places.tolist(), found.radii.tolist(), self._draw.add_circle_filled
        for n in range(len(rays)):
            of_ray = np.flatnonzero(found.ray == n)
            # most are covered if one looks along the ray
            shown = of_ray[uncovered(found.places[of_ray], found.radii[of_ray])]
            discs = [(ImVec2(*places[k]), radii[k], fills[k]) for k in shown.tolist()]
            for color, reach in rims:
                tint = packed(color if isinstance(color, ImVec4) else color[n])
                for place, radius, _ in discs:
                    circle(place, radius + reach, tint)
            for disc in discs:
                circle(*disc)

    def tags(
        self, starts: np.ndarray, ends: np.ndarray, texts: list[str], em: float, colors: list[ImVec4], ink: ImVec4
    ) -> None:
        """Draw names at the visible ends of world segments (N, 3), inside the picture and without overlaps.

        They are written in `ink` on `colors`.
        """
        a, b, visible = clip_segments(self._camera, starts, ends, self._near)
        taken: list[Box] = []
        for k in np.flatnonzero(visible).tolist():
            taken.append(clear_of(taken, self._tag_box(a[k], b[k], texts[k], em), self._camera.height))
            self._tag(taken[-1], texts[k], em, colors[k], ink)

    def _tag_box(self, start: np.ndarray, end: np.ndarray, text: str, em: float) -> Box:
        size, pad, gap = (
            imgui.calc_text_size(text),
            TAG_PAD_EM * em,
            1.4 * em,
        )  # the gap leaves space for the mark of a sample
        x, y = end
        leftwards = x < start[0] - em  # em: for a ray seen from its own camera the sign is only rounding
        x = x - gap - size.x if leftwards else x + gap
        x = max(min(x, self._camera.width - size.x - pad), pad)
        y = max(min(y - size.y / 2, self._camera.height - size.y), 0.0)
        return Box(x - pad, y, size.x + 2 * pad, size.y)

    def _tag(self, box: Box, text: str, em: float, color: ImVec4, ink: ImVec4) -> None:
        left, top = float(int(self._origin[0] + box.x)), float(int(self._origin[1] + box.y))
        far = ImVec2(left + box.width, top + box.height)
        self._draw.add_rect_filled(ImVec2(left, top), far, packed(color), 0.2 * em)
        self._draw.add_text(ImVec2(left + TAG_PAD_EM * em, top), packed(ink), text)

    def sample_at(self, ray: RayProbe, em: float, x: float, y: float) -> int | None:
        """Return the sample of the last pass whose disc is at, or nearly at, a screen position; None if there is none.

        While the eye is on the ray it is None too, because all samples then lie behind each other in one pixel.
        """
        if self._on(ray):
            return None
        found = self._discs([ray], em)
        apart = np.hypot(*(found.places - (x, y)).T)
        apart = np.where(
            apart < found.radii + REACH_EM * em, apart, np.inf
        )  # of overlapping discs, the one with the nearest centre
        return int(found.sample[apart.argmin()]) if np.isfinite(apart).any() else None

    def visits(self, ray: RayProbe, em: float, ink: Ink, marked: int | None = None, numbered: bool = True) -> None:
        """Draw the places that a method without samples looked at, as discs with their numbers; see `discs`.

        One that a later disc covers is left out: while the eye is on the ray, all lie behind each other.
        """
        places, seen = self._visited(ray)
        index = np.flatnonzero(seen)
        kept = index[uncovered(places[index], np.full(len(index), DISC_EM * em))]
        centres: list[ImVec2 | None] = [None] * len(places)
        for k in kept.tolist():
            centres[k] = ImVec2(*places[k])
        discs(self._draw, centres, em, ink, marked, numbered)

    def visit_at(self, ray: RayProbe, em: float, x: float, y: float) -> int | None:
        """Return the visit whose disc is at, or nearly at, a screen position, as `sample_at` does for samples."""
        places, seen = self._visited(ray)
        if not seen.any() or self._on(ray):
            return None
        apart = np.where(seen, np.hypot(*(places - (x, y)).T), np.inf)
        nearest = int(apart.argmin())
        return nearest if apart[nearest] < (DISC_EM + REACH_EM) * em else None

    def _visited(self, ray: RayProbe) -> tuple[np.ndarray, np.ndarray]:
        """The screen positions (V, 2) of the visits, and which of them lie before the camera (V,)."""
        pixels, depth = self._camera.project(ray.origin + ray.visited[:, None] * ray.direction)
        return pixels + self._origin, (depth >= self._near) & np.isfinite(pixels).all(-1)

    def _on(self, ray: RayProbe) -> bool:
        """Whether the eye is on a ray: all that lies on it is then behind each other in one pixel."""
        aside = np.linalg.norm(np.cross(self._camera.c2w[:, 3] - ray.origin, ray.direction))
        return bool(aside < self._near)

    def _discs(self, rays: Sequence[RayProbe], em: float) -> _Discs:
        """The visible samples of the last passes of some rays, ray by ray, those of each from far to near."""
        weights, t = (np.concatenate([getattr(ray.last, name) for ray in rays]) for name in ("weights", "t"))
        drawn = np.flatnonzero(weights > FAINT)
        which = np.repeat(np.arange(len(rays)), [len(ray.last.t) for ray in rays])[drawn]
        origins, ways = (np.array([getattr(ray, name) for ray in rays])[which] for name in ("origin", "direction"))
        pixels, depth = self._camera.project(origins + t[drawn, None] * ways)
        order = np.lexsort((-depth, which))
        order = order[depth[order] >= self._near]
        # samples of the smallest weight still show their colour
        radii = em * (0.2 + 0.36 * np.sqrt(weights[drawn[order]]))
        return _Discs(which[order], drawn[order], pixels[order] + self._origin, radii)

    def ring(self, position: np.ndarray, radius: float, color: ImVec4, thickness: float) -> None:
        """Draw a circle of `radius` pixels around a world point."""
        pixels, depth = self._camera.project(np.asarray(position, dtype=np.float64)[None])
        if depth[0] >= self._near:
            self._draw.add_circle(ImVec2(*(pixels[0] + self._origin)), radius, packed(color), thickness=thickness)

    def point(self, position: np.ndarray, em: float, color: ImVec4) -> None:
        """Draw a crosshair with a gap, so that the marked point stays visible."""
        pixels, depth = self._camera.project(np.asarray(position, dtype=np.float64)[None])
        if depth[0] < self._near:
            return
        x, y = pixels[0] + self._origin
        tint = packed(color)
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            start, end = ImVec2(x + 0.25 * em * dx, y + 0.25 * em * dy), ImVec2(x + 0.7 * em * dx, y + 0.7 * em * dy)
            self._draw.add_line(start, end, tint, max(1.0, 0.1 * em))


class _Discs(NamedTuple):
    """K samples of rays on the screen.

    ray: (K,) int, which ray. sample: (K,) int, which of the rays' samples, counted over all rays.
    places: (K, 2) centres in pixels of the screen. radii: (K,) in pixels.
    """

    ray: np.ndarray
    sample: np.ndarray
    places: np.ndarray
    radii: np.ndarray


@dataclass(frozen=True)
class Box:
    """A rectangle in pixels from the picture's top left corner."""

    x: float
    y: float
    width: float
    height: float


def clear_of(taken: list[Box], box: Box, bottom: float) -> Box:
    """Move a box by the fewest whole rows, up or down, until it covers no taken box and ends above `bottom`.

    If no row is free, the box stays where it is.
    """
    rows = 2 * len(taken)
    for row in sorted(range(-rows, rows + 1), key=abs):
        at = replace(box, y=box.y + row * (box.height + 1))
        free = all(
            abs(at.y - other.y) >= box.height or at.x + at.width <= other.x or other.x + other.width <= at.x
            for other in taken
        )
        if free and 0 <= at.y <= bottom - box.height:
            return at
    return box


def uncovered(places: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return which discs, drawn in this order, are not completely covered by a later one, as bool (K,).

    places: (K, 2) centres. radii: (K,).
    """
    if len(radii) > MANY:
        return np.ones(len(radii), bool)
    x, y = (np.subtract.outer(axis, axis) for axis in places.T)
    larger = radii - radii[:, None] + 1e-3  # in pixels; 1e-3: places come from float32
    covers = (larger >= 0) & (x * x + y * y <= larger * larger)  # np.hypot takes several times as long
    return ~np.triu(covers, 1).any(1)


def clip_segments(
    camera: Camera, starts: np.ndarray, ends: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clip world segments (N, 3), (N, 3) to their visible parts in pixels (N, 2), (N, 2); also which (N,) are visible.

    They are clipped in space at z-depth `near`, because a point behind the eye has no pixel. Then they are clipped at
    the picture's edges (Liang and Barsky), because a rasteriser cannot take very large coordinates.
    """
    starts, ends = np.asarray(starts, dtype=np.float64), np.asarray(ends, dtype=np.float64)
    axis = -camera.c2w[:, 2]
    za, zb = (starts - camera.c2w[:, 3]) @ axis, (ends - camera.c2w[:, 3]) @ axis
    visible = (za >= near) | (zb >= near)
    span = np.where(
        za == zb, 1.0, zb - za
    )  # a segment parallel to the plane is not cut; this avoids a division by zero
    cut = starts + ((near - za) / span)[:, None] * (ends - starts)
    a = camera.project(np.where((za < near)[:, None], cut, starts))[0]
    b = camera.project(np.where((zb < near)[:, None], cut, ends))[0]
    first, last = np.zeros(len(a)), np.ones(len(a))
    way = b - a
    for dimension, size in ((0, camera.width), (1, camera.height)):
        for sign, edge in ((-1.0, 0.0), (1.0, float(size))):
            speed = sign * way[:, dimension]
            room = sign * (edge - a[:, dimension])
            at = room / np.where(speed == 0, 1.0, speed)
            first = np.where(speed < 0, np.maximum(first, at), first)
            last = np.where(speed > 0, np.minimum(last, at), last)
            visible &= (speed != 0) | (room >= 0)
    visible &= first < last
    return a + first[:, None] * way, a + last[:, None] * way, visible


def spread_views(count: int) -> list[int]:
    """Return which of `count` cameras are drawn: all, or MOST_FRUSTA of them, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_FRUSTA)).round().astype(int)).tolist()


def frusta(cameras: list[Camera], size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of each camera's pyramid, `size` deep: starts and ends (8·N, 3)."""
    table = np.array([(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in cameras], np.float64).reshape(-1, 6)
    width, height, fx, fy, cx, cy = table.T[:, :, None]
    c2w = np.array([c.c2w for c in cameras], np.float64).reshape(-1, 3, 4)
    x, y = (width * [0, 1, 1, 0] - cx) / fx, (height * [0, 0, 1, 1] - cy) / fy
    corners = np.stack([x, -y, -np.ones_like(x)], -1) * size @ c2w[:, :, :3].swapaxes(1, 2) + c2w[:, None, :, 3]
    eyes = np.broadcast_to(c2w[:, None, :, 3], corners.shape)
    starts, ends = np.concatenate([eyes, corners], 1), np.concatenate([corners, np.roll(corners, -1, 1)], 1)
    return starts.reshape(-1, 3), ends.reshape(-1, 3)


def axis_directions(camera: Camera, up: np.ndarray) -> list[tuple[np.ndarray, float, bool]]:
    """Return the world axes x, y, z as seen by the camera.

    For each: (2,) right and down on the screen, its component towards the viewer, and whether it is the up axis.
    """
    found = []
    for k in range(3):
        axis = np.eye(3)[k]
        x, y, z = axis @ camera.c2w[:, :3]
        found.append((np.array([x, -y]), float(z), bool(abs(axis @ up) > 0.99)))
    return found
