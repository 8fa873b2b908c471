"""What a window shows of Flatland. Numpy only, so that messages can carry it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FlatPass:
    """One pass of a ray.

    name: "coarse" or "fine".
    t, sigma, alpha, transmittance, weights: (S,) of its samples.
    rgb: (S, 3) in [0, 1].
    color: (3,) the composited pixel.
    """

    name: str
    t: np.ndarray
    sigma: np.ndarray
    alpha: np.ndarray
    transmittance: np.ndarray
    weights: np.ndarray
    rgb: np.ndarray
    color: np.ndarray


@dataclass(frozen=True)
class FlatRay:
    """A ray with all its samples.

    camera, pixel: whose it is; see `FlatView.cameras`.
    origin, direction: (2,); the direction has unit length.
    near, far: between these distances lie its samples.
    passes: of the coarse network, and then of the fine one if there is one.
    truth: (3,) the colour of the exact photo.
    true_t, true_sigma: (N,) the world's density along the ray.
    """

    camera: int
    pixel: int
    origin: np.ndarray
    direction: np.ndarray
    near: float
    far: float
    passes: tuple[FlatPass, ...]
    truth: np.ndarray
    true_t: np.ndarray
    true_sigma: np.ndarray


@dataclass(frozen=True)
class FlatView:
    """Flatland at one moment.

    cameras: (N, 2) their places. The first `training` ones took the training photos, the others are held out.
    training: how many they are.
    photos: (N, W, 3) uint8, what the training photos hold, with their noise, and the exact photos of held-out cameras.
    learnt: (N, W, 3) uint8, what the networks draw of them.
    field, truth: (S, S, 3) uint8, the learnt field and the world over [−1, 1]², y upwards, as the ray's camera sees
        them.
    step: the training step. psnr: of the held-out photos, in dB; NaN: not measured yet.
    steps_per_second: lately.
    ray: the ray that was chosen.
    """

    cameras: np.ndarray
    training: int
    photos: np.ndarray
    learnt: np.ndarray
    field: np.ndarray
    truth: np.ndarray
    step: int
    psnr: float
    steps_per_second: float
    ray: FlatRay | None = None
