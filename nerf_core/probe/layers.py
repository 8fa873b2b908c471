"""What lies along a ray, as one would say it: so many layers, here and there, of such weight, thickness and colour."""

from __future__ import annotations

import numpy as np

from nerf_core.geometry.scene import Scene
from nerf_core.probe.records import PassProbe, RayProbe
from nerf_core.probe.standing import Layer

GRAIN = 0.02  # of the scene's radius: what is closer together counts as one layer, and beyond
FAR_GRAIN = 0.01  # of its distance, where that is more: far away, as cameras resolve it
BINS = 2  # to a grain
VALLEY = 0.5  # two peaks are one layer unless the weight between them falls under this share of the lesser one's
SURFACE = 0.25  # of a layer's weight lies in front of the surface that it stands for
LIGHTEST = 0.02  # weight of what is worth to be called a layer


def layers_of(ray: RayProbe, scene: Scene) -> tuple[Layer, ...]:
    """The layers of the pass that made the pixel, front to back: peaks of weight over t, parted at the valleys between.

    Weight is counted in bins half a grain wide. From the highest bin down, each joins the peak it touches; where two
    peaks meet, they are one unless the meeting bin is under VALLEY of the lesser.
    """
    return pass_layers(ray.passes[-1], ray.far, scene.radius)


def grain_at(t: float, radius: float) -> float:
    return max(GRAIN * radius, FAR_GRAIN * t)


def pass_layers(p: PassProbe, far: float, radius: float) -> tuple[Layer, ...]:
    """`layers_of` one pass; far: distance behind which a sample without end is as if it had none."""
    if not len(p.t) or not np.isfinite(p.weights).all():
        return ()
    t = p.t.astype(np.float64)
    until = np.minimum(np.maximum(p.until.astype(np.float64), t), np.append(t[1:], np.inf))
    until = np.where(np.isfinite(until) & (until < 4 * max(far, t[-1])), until, t + GRAIN * radius)  # δ without end
    weights = p.weights.astype(np.float64)
    low, high = _grains(t, radius), _grains(np.maximum(until, t + 1e-9 * radius), radius)
    edges = np.arange(np.floor(low[0] * BINS), np.ceil(high.max() * BINS) + 2) / BINS
    # the accumulated weight, linear within a sample and level between two
    knots = np.maximum.accumulate(np.stack([low, high], -1).ravel())
    total = np.concatenate([[0], np.cumsum(weights)])
    reached = np.stack([total[:-1], total[1:]], -1).ravel()
    binned = np.diff(np.interp(edges, knots, reached))
    found = []
    for first, last in _peaks(np.convolve(np.pad(binned, 1), [0.25, 0.5, 0.25], "valid")):
        a, b = np.interp([edges[first], edges[last + 1]], knots, reached)
        if b - a < LIGHTEST:
            continue
        quantiles = np.interp(a + (b - a) * np.array([0.001, 0.1, SURFACE, 0.5, 0.9, 0.999]), reached, knots)
        begin, q10, surface, middle, q90, end = (_distance(float(s), radius) for s in quantiles)
        inside = (low < edges[last + 1]) & (high > edges[first])
        share = weights * inside
        front = max(int(np.searchsorted(total, a, side="right")) - 1, 0)
        light = float(p.transmittance[min(front, len(t) - 1)])
        color = share @ p.rgb / max(share.sum(), 1e-12)
        grain = grain_at(middle, radius)
        found.append(Layer(middle, surface, begin, end, q90 - q10, grain, b - a, light, color))
    return tuple(found)


def _grains(t: np.ndarray, radius: float) -> np.ndarray:
    """Distances counted in grains: ∫ dt / grain(t), straight up to where far grains are longer, a logarithm behind."""
    turn = GRAIN * radius / FAR_GRAIN
    near = np.minimum(t, turn) / (GRAIN * radius)
    return near + np.log(np.maximum(t, turn) / turn) / FAR_GRAIN


def _distance(s: float, radius: float) -> float:
    """The inverse of `_grains`."""
    turn = GRAIN * radius / FAR_GRAIN
    most = turn / (GRAIN * radius)
    return s * GRAIN * radius if s <= most else turn * float(np.exp((s - most) * FAR_GRAIN))


def _peaks(height: np.ndarray) -> list[tuple[int, int]]:
    """The first and last bin of each peak, in order."""
    peak = np.full(len(height), -1)
    top: dict[int, int] = {}
    parent: dict[int, int] = {}

    def root(k: int) -> int:
        while parent[k] != k:
            k = parent[k]
        return k

    for i in np.argsort(-height, kind="stable").tolist():
        if height[i] <= 0:
            break
        beside = sorted({root(int(peak[j])) for j in (i - 1, i + 1) if 0 <= j < len(height) and peak[j] >= 0})
        if not beside:
            parent[i], top[i], peak[i] = i, i, i
            continue
        higher, *other = sorted(beside, key=lambda k: -height[top[k]])
        peak[i] = higher
        for lesser in other:
            if height[i] >= VALLEY * height[top[lesser]]:
                parent[lesser] = higher
    found: dict[int, list[int]] = {}
    for i in np.flatnonzero(peak >= 0).tolist():
        found.setdefault(root(int(peak[i])), []).append(i)
    return sorted((bins[0], bins[-1]) for bins in found.values())
