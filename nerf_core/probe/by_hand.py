"""A ray by hand: volume rendering of a few samples in numpy, term by term, and sampling by their weights.

The same formulas as `nerf_core.volume.compositing` and `nerf_core.volume.sampling`, without torch: a window can compute
them in every frame. Both are those of Mildenhall et al. 2020 (arXiv:2003.08934): Eq. 3 for the colour of a ray, Eq. 5
for the weights as a distribution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerf_core.probe.records import PassProbe

FLOOR = 1e-5  # added to each weight, as in nerf_core.volume.sampling: a ray that meets nothing has a distribution too
MANY = 64  # samples: above it, all pairs are merged at once that are more alike than those beside them
OPAQUE = 20.0  # optical depth from which a merged stretch counts as opaque: 1 − α is under 1e-8


@dataclass(frozen=True)
class HandRay:
    """N samples along a ray, front to back. The field that they define is constant from one to the next.

    t: (N,) distances in world units, ascending, all under `far`.
    sigma: (N,) densities σ ≥ 0, per world unit.
    rgb: (N, 3) colours in [0, 1].
    near, far: where the ray begins and ends, in world units. The stretch of the last sample ends at `far`. Between
        `near` and the first sample the ray is empty.
    background: (3,) the colour behind the ray's end.
    """

    t: np.ndarray
    sigma: np.ndarray
    rgb: np.ndarray
    near: float
    far: float
    background: np.ndarray

    @property
    def edges(self) -> np.ndarray:
        """(N + 1,) the ends of the samples' stretches: t and `far`."""
        return np.append(self.t, self.far)


@dataclass(frozen=True)
class HandTerms:
    """The terms of NeRF Eq. 3 for one ray; see `hand_terms`.

    delta, alpha, transmittance, weights: (N,) δ, α, T and w of each sample.
    sums: (N, 3) the colour that the first samples make together, up to and with each.
    left: the transmittance behind the last sample: the background's part of the pixel.
    pixel: (3,) the ray's colour over the background.
    """

    delta: np.ndarray
    alpha: np.ndarray
    transmittance: np.ndarray
    weights: np.ndarray
    sums: np.ndarray
    left: float
    pixel: np.ndarray


def hand_terms(ray: HandRay) -> HandTerms:
    """Compute all terms of a ray's colour: NeRF Eq. 3 (arXiv:2003.08934).

        δ_i = t_{i+1} − t_i,  α_i = 1 − exp(−σ_i δ_i),  T_i = Π_{j<i} (1 − α_j) = exp(−Σ_{j<i} σ_j δ_j),
        w_i = T_i α_i,  Ĉ = Σ w_i c_i + (1 − Σ w_i) background

    The last δ reaches to `far`. The paper's equation has no background; its code composites over one in the same way.

    Args:
        ray: the samples; without any, the pixel is the background.

    Returns:
        The terms, as float64.
    """
    delta = np.diff(ray.edges)
    tau = ray.sigma * delta
    alpha = -np.expm1(-tau)
    reached = np.exp(-np.concatenate([[0.0], np.cumsum(tau)]))
    weights = reached[:-1] * alpha
    sums = np.cumsum(weights[:, None] * ray.rgb, axis=0)
    seen = sums[-1] if len(sums) else np.zeros(3)
    left = 1.0 - float(weights.sum())
    return HandTerms(delta, alpha, reached[:-1], weights, sums, left, seen + left * ray.background)


def hand_cdf(ray: HandRay) -> np.ndarray:
    """Return the CDF of the weights' distribution at `ray.edges`, (N + 1,) from 0 to 1.

    The weights are normalised to a PDF that is constant within each stretch: ŵ_i = w_i / Σ w_j, NeRF Eq. 5.
    """
    weights = hand_terms(ray).weights + FLOOR
    return np.concatenate([[0.0], np.cumsum(weights / weights.sum())])


def hand_levels(count: int) -> np.ndarray:
    """Return the levels of the CDF at which samples are placed: (k + ½) / `count` for k = 0 … `count` − 1.

    They are the middles of equal shares of the weight. At level 1 a sample would lie at `far`, where nothing is left.
    """
    return (np.arange(count) + 0.5) / count


def resample_by_weights(ray: HandRay, count: int) -> np.ndarray:
    """Place samples where the weight is: inverse transform sampling, as the paper's fine pass (NeRF, section 5.2).

    The CDF of the weights is inverted at `hand_levels`, as `nerf_core.volume.sampling.quantiles` does at given levels.
    Training draws random levels instead. The renderer's are evenly spaced from 0 to 1, both included.

    Args:
        ray: at least one sample.
        count: how many samples to place.

    Returns:
        Their distances (count,), ascending.
    """
    cdf, edges, u = hand_cdf(ray), ray.edges, hand_levels(count)
    bins = np.clip(np.searchsorted(cdf, u, side="right") - 1, 0, len(ray.t) - 1)
    share = (u - cdf[bins]) / (cdf[bins + 1] - cdf[bins])  # FLOOR keeps the width above 0
    return edges[bins] + (edges[bins + 1] - edges[bins]) * np.clip(share, 0.0, 1.0)


def spread_evenly(ray: HandRay, count: int) -> np.ndarray:
    """Return distances (count,) that divide the ray from near to far into equal stretches: what the weights improve on.

    A distance is the beginning of its stretch, as everywhere here.
    """
    return ray.near + (ray.far - ray.near) * np.arange(count) / count


def sampled_at(ray: HandRay, t: np.ndarray) -> HandRay:
    """Sample the field that a ray's samples define at other distances.

    Args:
        ray: the samples that define it.
        t: (M,) distances, ascending, between near and far.

    Returns:
        A ray of M samples: each has σ and colour of the stretch in which it lies, and σ = 0 before the first stretch.
    """
    at = np.searchsorted(ray.t, t, side="right") - 1
    inside = (at >= 0) & (len(ray.t) > 0)
    at = np.clip(at, 0, max(len(ray.t) - 1, 0))
    sigma = np.where(inside, ray.sigma[at], 0.0) if len(ray.t) else np.zeros(len(t))
    rgb = np.where(inside[:, None], ray.rgb[at], 0.0) if len(ray.t) else np.zeros((len(t), 3))
    return HandRay(t, sigma, rgb, ray.near, ray.far, ray.background)


def hand_ray_of(p: PassProbe, near: float, far: float, background: np.ndarray, most: int) -> HandRay:
    """Merge the samples of an opened ray into a few whose pixel is the same.

    Neighbours are merged, always the two that are the most alike in place and colour for their weight, until `most` are
    left (Ward's criterion, 1963). A merged sample has the weight of those that it stands for and their mean colour
    Σ w c / Σ w. So the pixel stays; what is lost is the detail within a merged stretch.

    Args:
        p: the pass that makes the pixel.
        near, far: the part of the ray that is wanted, in world units. Samples outside it are left out.
        background: (3,) the colour behind the ray.
        most: how many samples to return at most, ≥ 1.

    Returns:
        The merged ray. It has no samples if none lies in the part.
    """
    t = p.t.astype(np.float64)
    kept = (t >= near) & (t < far)
    t = t[kept]
    weights, tau = (
        np.clip(np.nan_to_num(v[kept].astype(np.float64)), 0.0, None) for v in (p.weights, p.sigma * p.delta)
    )
    rgb = np.clip(np.nan_to_num(p.rgb[kept].astype(np.float64)), 0.0, 1.0)
    edges = np.append(t, far)
    middle = (edges[1:] + edges[:-1]) / 2
    mean = np.average(middle, weights=weights) if weights.sum() > 0 else middle.mean() if len(t) else 0.0
    spread = np.sqrt(np.average((middle - mean) ** 2, weights=weights + 1e-12)) if len(t) else 1.0
    # Empty stretches count a little, so that air and fog are merged last.
    mass = weights + 1e-3 * np.diff(edges) / max(far - near, 1e-12)
    begin, features = np.arange(len(t)), np.column_stack([middle / max(float(spread), 1e-12), rgb])
    while len(begin) > most:
        a, b = mass[:-1], mass[1:]
        share = b / np.maximum(a + b, 1e-300)
        cost = a * share * ((features[1:] - features[:-1]) ** 2).sum(-1)
        k = np.array([np.argmin(cost)])
        if len(begin) > MANY:  # one by one would take a tenth of a second for a thousand samples
            padded = np.concatenate([[np.inf], cost, [np.inf]])
            least = (cost < padded[:-2]) & (cost <= padded[2:]) & (cost <= np.median(cost))
            k = np.flatnonzero(least) if least.any() else k
        features[k] += share[k, None] * (features[k + 1] - features[k])
        mass[k] += mass[k + 1]
        begin, mass = np.delete(begin, k + 1), np.delete(mass, k + 1)
        features = np.delete(features, k + 1, axis=0)
    if not len(begin):
        return HandRay(t, tau, rgb, near, far, background)
    total = np.add.reduceat(weights, begin)
    color = np.add.reduceat(weights[:, None] * rgb, begin) / np.maximum(total, 1e-12)[:, None]
    color = np.where((total > 1e-9)[:, None], color, rgb[begin])  # nothing is seen of it: any of its colours will do
    depth = np.minimum(np.add.reduceat(tau, begin), OPAQUE)
    sigma = depth / np.maximum(np.diff(np.append(t[begin], far)), 1e-12)
    return HandRay(t[begin], sigma, color, near, far, background)
