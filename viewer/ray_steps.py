"""What a ray's plots draw of each pass: its samples as stairs over t."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerf_core.probe import PassProbe, RayProbe


@dataclass(frozen=True)
class Steps:
    """One pass as stairs: value i holds from edge i to edge i + 1, (S + 1,) each, the last value repeated."""

    probe: PassProbe
    edges: np.ndarray
    weights: np.ndarray
    sigma: np.ndarray
    transmittance: np.ndarray  # at the edges; the last is what passes the whole ray


def steps_of(ray: RayProbe) -> tuple[Steps, ...]:
    """The passes that hold samples. The last sample of a ray reaches as far as its δ, at most to the far end."""
    return tuple(_steps(p, ray.far) for p in ray.passes if len(p.t))


def _steps(p: PassProbe, far: float) -> Steps:
    last = float(p.t[-1])
    edges = np.append(p.t, min(max(far, last), last + float(p.delta[-1]))).astype(np.float64)
    left = np.append(p.transmittance, p.transmittance[-1] * (1 - p.alpha[-1]))
    clean = [np.nan_to_num(v).astype(np.float64) for v in (_hold(p.weights), _hold(p.sigma), left)]
    return Steps(p, np.nan_to_num(edges), *clean)


def _hold(values: np.ndarray) -> np.ndarray:
    return np.append(values, values[-1])


def wants_log(sigma: np.ndarray) -> bool:
    """Whether a linear axis would flatten most of the density: its peak stands 50 times over its median."""
    positive = sigma[sigma > 0]
    return len(positive) > 0 and bool(positive.max() > 50 * np.median(positive))
