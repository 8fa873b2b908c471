"""The axis over t of a ray's plots: which part of the ray it shows, and where it puts distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from nerf_core.geometry.scene import Scene
from nerf_core.probe.layers import grain_at
from nerf_core.probe.records import PassProbe, RayProbe
from nerf_core.probe.verdicts import NOTHING

MET = 0.995  # from this opacity on, the expected depth is that of the whole pixel
TAIL = 0.001  # the share of a pass's weight, at either end, that may lie outside the shown part of the ray
MARGIN = 0.15  # the shown part is extended on either side by this share of its length
FAR = 4.0  # turns: see `chosen_axis`
FEWEST = 4.0  # grains: the shown part is at least this long
ROUND = np.array([0.0, *(m * 10.0**k for k in range(-4, 7) for m in (1, 2, 5))])  # distances that are worth a tick
APART = 0.07  # of the axis: ticks are at least this far apart


@dataclass(frozen=True)
class Axis:
    """Puts world distances t ≥ 0 along a ray on an axis.

    turn: None puts t at t. Otherwise distances up to `turn` stay, and those behind it come closer:
        s(t) = turn (2 − turn / t), which ends at 2 turn for t = ∞. It is mip-NeRF 360's Eq. 10 (arXiv:2111.12077) along
        the ray.
    """

    turn: float | None = None

    def place(self, t: np.ndarray) -> np.ndarray:
        """Return the places s (N,) on the axis of distances (N,) in world units."""
        if self.turn is None:
            return t
        return np.where(t <= self.turn, t, self.turn * (2 - self.turn / np.maximum(t, self.turn)))

    def distance(self, s: np.ndarray) -> np.ndarray:
        """Return the distances (N,) at places s (N,): the inverse of `place`. From 2 turn on, infinity."""
        if self.turn is None:
            return s
        with np.errstate(divide="ignore"):
            return np.where(s <= self.turn, s, self.turn / np.maximum(2 - s / self.turn, 0.0))

    def ticks(self, low: float, high: float) -> tuple[np.ndarray, list[str]]:
        """Return places and labels of round distances between two places, with ∞ where it is reached."""
        assert self.turn is not None  # the plotting libraries have ticks for t itself
        places = np.append(self.place(ROUND), 2 * self.turn)
        labels = [f"{t:g}" for t in ROUND] + ["∞"]
        rank = {"": 0, "∞": 0, "1": 1}  # by the first digit that is not 0; the roundest first
        best = sorted(range(len(labels)), key=lambda k: rank.get(labels[k].strip("0.")[:1], 2))
        kept: list[int] = []
        for k in best:
            near = any(abs(places[k] - places[other]) < APART * (high - low) for other in kept)
            if low <= places[k] <= high and not near:
                kept.append(k)
        kept.sort()
        return places[kept], [labels[k] for k in kept]


PLAIN = Axis()
AxisChoice = Literal["auto", "t", "contracted"]


def contracted_axis(ray: RayProbe, scene: Scene) -> Axis | None:
    """Return the axis of contracted distance; None for a scene that is not contracted (`Space.of`).

    It turns where the ray leaves the inner cube, and not before the cube's half side.
    """
    if scene.ndc is not None or scene.synthetic:
        return None
    o, d = ray.origin - scene.center, ray.direction.astype(np.float64)
    d = np.where(np.abs(d) < 1e-12, 1e-12, d)  # a ray along a face leaves by the others
    ends = np.sort(np.stack([-scene.radius - o, scene.radius - o]) / d, axis=0)
    enters, leaves = float(ends[0].max()), float(ends[1].min())
    return Axis(max(leaves if leaves > enters else 0.0, scene.radius))


def chosen_axis(ray: RayProbe, scene: Scene, choice: AxisChoice, part: tuple[float, float]) -> Axis:
    """Return the axis that a choice means.

    "auto" takes contracted distance if the part of the ray that has weight reaches behind FAR times the distance from
    which it contracts: over t, all that is near would lie at one end.
    """
    contracted = contracted_axis(ray, scene)
    if contracted is None or contracted.turn is None or choice == "t":
        return PLAIN
    return contracted if choice == "contracted" or part[1] > FAR * contracted.turn else PLAIN


def weighty_part(ray: RayProbe, passes: tuple[PassProbe, ...], radius: float, *points: float) -> tuple[float, float]:
    """Return begin and end of the part of a ray that a plot shows first, as world distances.

    It holds the weight of each pass but for TAIL at either end, the depths within it, and `points`. It is the whole ray
    if the ray meets nothing. The expected depth may lie outside: a little weight at a great distance moves it far.

    Args:
        ray: an opened ray.
        passes: its passes, with finite weights.
        radius: the scene's radius, in world units.
        points: further distances to be shown.
    """
    places = [t for t in (ray.depth_median, ray.depth_strongest, *points) if t is not None and np.isfinite(t)]
    for p in passes:
        total = np.cumsum(p.weights, dtype=np.float64)
        if total[-1:].sum() >= NOTHING:
            first, last = np.searchsorted(total, total[-1] * np.array([TAIL, 1 - TAIL]))
            t = p.t.astype(np.float64)
            last = min(int(last), len(t) - 1)
            end = np.clip(float(p.until[last]), t[last], t[last + 1] if last + 1 < len(t) else max(ray.far, t[-1]))
            places += [float(t[first]), float(end)]
    if passes[-1].weights.sum() < NOTHING:
        places += [ray.near, ray.far]
    low, high = min(places), max(places)
    least = FEWEST * grain_at(high, radius)
    room = max(MARGIN * (high - low), (least - (high - low)) / 2)
    low, high = max(low - room, min(low, ray.near)), min(high + room, max(high, ray.far))
    return low, max(high, low + 1e-6)
