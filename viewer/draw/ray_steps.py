"""The samples of each pass as stairs over t, for the plots of a ray."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nerf_core.probe import PassProbe, RayProbe
from nerf_core.probe.axis import Axis

CONTIGUOUS = 1e-3  # of a sample's length: smaller gaps are rounding


@dataclass(frozen=True)
class Steps:
    """One pass. Sample i covers the ray from t[i] to until[i], (S,) each; until ends at the far end at the latest.

    edges, weights, sigma, alpha, transmittance: (E,), stairs from the near end to the far end. Value i holds from edge
    i to the next and is 0 where no sample covers the ray; transmittance is the value at the edges.
    """

    probe: PassProbe
    t: np.ndarray
    until: np.ndarray
    edges: np.ndarray
    weights: np.ndarray
    sigma: np.ndarray
    alpha: np.ndarray
    transmittance: np.ndarray


def steps_of(ray: RayProbe) -> tuple[Steps, ...]:
    """Return the passes that have samples."""
    return tuple(_steps(p, ray.near, ray.far) for p in ray.passes if len(p.t))


def _steps(p: PassProbe, near: float, far: float) -> Steps:
    t = np.nan_to_num(p.t.astype(np.float64))
    end = far if t[-1] < far else t[-1] + far - near  # the last δ may be infinite
    beyond = np.append(t[1:], end)
    until = np.clip(np.nan_to_num(p.until.astype(np.float64), nan=np.inf), t, beyond)
    light, left = p.transmittance, p.transmittance[-1] * (1 - p.alpha[-1])
    kept = np.stack([np.ones(len(t), bool), beyond - until > CONTIGUOUS * (until - t)], 1)
    kept[-1, 1] = True
    edges, weights, sigma, alpha, light = (
        np.nan_to_num(np.stack(pair, 1)[kept].astype(np.float64))
        for pair in (
            (t, until), (p.weights, np.zeros(len(t))), (p.sigma, np.zeros(len(t))), (p.alpha, np.zeros(len(t))),
            (light, np.append(light[1:], left)),
        )
    )  # fmt: skip
    before = [] if t[0] <= near else [near]
    after = [] if until[-1] >= far else [far]
    nothing = [0.0] * len(before), [0.0] * len(after)
    return Steps(
        p,
        t,
        until,
        np.concatenate([before, edges, after]),
        np.concatenate([nothing[0], weights, nothing[1]]),
        np.concatenate([nothing[0], sigma, nothing[1]]),
        np.concatenate([nothing[0], alpha, nothing[1]]),
        np.concatenate([[1.0] * len(before), light, light[-1:] if after else []]),
    )


def placed(steps: Steps, axis: Axis) -> Steps:
    """Return a pass with the places of an axis instead of distances."""
    return replace(steps, t=axis.place(steps.t), until=axis.place(steps.until), edges=axis.place(steps.edges))


def wants_log(sigma: np.ndarray) -> bool:
    """Return whether a linear axis would flatten most of the density: its peak is over 50 times its median."""
    positive = sigma[sigma > 0]
    return len(positive) > 0 and bool(positive.max() > 50 * np.median(positive))


def sample_at(passes: tuple[Steps, ...], t: float, reach: float) -> tuple[Steps, int] | None:
    """Return the sample whose interval contains t, or begins or ends within `reach` of it.
    Of several it is the one that begins nearest. None: no sample covers the ray at t.
    """
    found, least = None, (reach, np.inf)
    for steps in passes:
        aside = np.maximum(np.maximum(steps.t - t, t - steps.until), 0.0)
        k = int(np.lexsort((np.abs(steps.t - t), aside))[0])
        if (apart := (float(aside[k]), abs(float(steps.t[k]) - t))) <= least:
            found, least = (steps, k), apart
    return found
