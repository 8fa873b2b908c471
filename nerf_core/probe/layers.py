"""Find the layers of a ray: the peaks of weight along it, with position, thickness, weight and colour."""

from __future__ import annotations

import numpy as np

from nerf_core.geometry.scene import Scene
from nerf_core.probe.records import PassProbe, RayProbe
from nerf_core.probe.standing import Layer

# A grain is the unit of length in which layers are measured; see `grain_at`.
GRAIN = 0.02  # the least grain, as a share of the scene's radius
FAR_GRAIN = 0.01  # the grain of far places, as a share of their distance, because cameras resolve them less finely
BINS = 2  # bins in a grain
VALLEY = 0.5  # two peaks are one layer unless the weight between them falls under this share of the lesser peak
SURFACE = 0.25  # the share of a layer's weight that lies in front of the surface that it stands for
LIGHTEST = 0.02  # a layer weighs at least this


def layers_of(ray: RayProbe, scene: Scene) -> tuple[Layer, ...]:
    """Find the layers of the pass that makes the pixel. They are the peaks of weight over t.

    The weight is counted in bins half a grain wide. From the highest bin down, each bin joins the peak that it touches.
    Where two peaks meet, they become one unless the bin between them is under VALLEY times the lesser peak.

    Args:
        ray: an opened ray.
        scene: its scene; the radius sets the length of a grain.

    Returns:
        The layers from front to back. Empty if no peak weighs LIGHTEST, or if weights are not finite.
    """
    return pass_layers(ray.last, ray.far, scene.radius)


def grain_at(t: float, radius: float) -> float:
    """Return the length of a grain: max(GRAIN · radius, FAR_GRAIN · t), in world units.

    What is closer together than this counts as one layer.

    Args:
        t: world distance along the ray.
        radius: the scene's radius, in world units.
    """
    return max(GRAIN * radius, FAR_GRAIN * t)


def pass_layers(p: PassProbe, far: float, radius: float) -> tuple[Layer, ...]:
    """Find the layers of one pass; see `layers_of`.

    Args:
        p: the pass.
        far: the ray's far bound, in world units. A sample whose stretch ends behind four times this bound, and
            behind four times the last sample, counts as endless. Its weight is placed in the stretch's first grain.
        radius: the scene's radius, in world units.
    """
    if not len(p.t) or not np.isfinite(p.weights).all():
        return ()
    t, weights = p.t.astype(np.float64), p.weights.astype(np.float64)
    low, high = _stretches(p, far, radius)
    edges = np.arange(np.floor(low[0] * BINS), np.ceil(high.max() * BINS) + 2) / BINS
    # the accumulated weight rises linearly within a sample and is constant between samples
    knots = np.stack([low, high], -1).ravel()
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
        share = weights * _overlaps(low, high, edges[first], edges[last + 1])
        front = max(int(np.searchsorted(total, a, side="right")) - 1, 0)
        light = float(p.transmittance[min(front, len(t) - 1)])
        color = share @ p.rgb / max(share.sum(), 1e-12)
        grain = grain_at(middle, radius)
        found.append(Layer(middle, surface, begin, end, q90 - q10, grain, b - a, light, color))
    return tuple(found)


def weights_in(p: PassProbe, far: float, radius: float, layer: Layer) -> np.ndarray:
    """Return how much of the weight of each sample (S,) lies between begin and end of a layer. Σ is `Layer.weight`.

    The weight is spread evenly over a sample's stretch, as in `pass_layers`. The sum lacks the thousandth on either
    side of the layer.

    Args:
        p: the pass in which the layer was found.
        far: the ray's far bound, in world units.
        radius: the scene's radius, in world units.
        layer: a layer of this pass.
    """
    begin, end = _grains(np.array([layer.begin, layer.end]), radius)
    return p.weights.astype(np.float64) * _overlaps(*_stretches(p, far, radius), begin, end)


def _stretches(p: PassProbe, far: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return begin and end of each sample's stretch, as numbers of grains: two times (S,), which never fall."""
    t = p.t.astype(np.float64)
    until = np.minimum(np.maximum(p.until.astype(np.float64), t), np.append(t[1:], np.inf))
    until = np.where(np.isfinite(until) & (until < 4 * max(far, t[-1])), until, t + GRAIN * radius)  # an endless δ
    low, high = _grains(t, radius), _grains(np.maximum(until, t + 1e-9 * radius), radius)
    knots = np.maximum.accumulate(np.stack([low, high], -1).ravel())
    return knots[::2], knots[1::2]


def _overlaps(low: np.ndarray, high: np.ndarray, begin: float, end: float) -> np.ndarray:
    """Return which share of each stretch (S,) from low to high lies between begin and end."""
    inside = np.minimum(high, end) - np.maximum(low, begin)
    whole = (low >= begin) & (high <= end)  # also a stretch without length
    return np.where(whole, 1.0, np.clip(inside / np.maximum(high - low, 1e-300), 0.0, 1.0))


def _grains(t: np.ndarray, radius: float) -> np.ndarray:
    """Convert distances to numbers of grains: ∫ dt / grain(t).

    This is linear up to the distance from which far grains are the longer ones, and logarithmic behind it.
    """
    turn = GRAIN * radius / FAR_GRAIN
    near = np.minimum(t, turn) / (GRAIN * radius)
    return near + np.log(np.maximum(t, turn) / turn) / FAR_GRAIN


def _distance(s: float, radius: float) -> float:
    """Convert a number of grains to a distance: the inverse of `_grains`."""
    turn = GRAIN * radius / FAR_GRAIN
    most = turn / (GRAIN * radius)
    return s * GRAIN * radius if s <= most else turn * float(np.exp((s - most) * FAR_GRAIN))


def _peaks(height: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last bin of each peak, in order. height: the weight of each bin, (B,)."""
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
