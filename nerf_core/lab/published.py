"""The numbers that the lecture's two tables state (NeRF, arXiv:2003.08934, tables 1 and 2)."""

from __future__ import annotations

from typing import NamedTuple

from nerf_core.geometry.scene import Scene


class Published(NamedTuple):
    """Means over all scenes of a dataset: PSNR in dB, SSIM, LPIPS."""

    psnr: float
    ssim: float
    lpips: float


# Table 1 by the names of methods here. A method that is named here for one of the paper is what can be learnt from one
# posed scene of it; docs/methods.md says what differs.
SYNTHETIC = {
    "srn": Published(22.26, 0.846, 0.170),
    "neural-volumes": Published(26.05, 0.893, 0.160),
    "mpi": Published(24.88, 0.911, 0.114),
    "nerf": Published(31.01, 0.947, 0.081),
}
FORWARD = {
    "srn": Published(22.84, 0.668, 0.378),
    "mpi": Published(24.13, 0.798, 0.212),
    "nerf": Published(26.50, 0.811, 0.250),
}
# Table 2, by the rows' numbers: means over the realistic synthetic scenes.
ABLATIONS = {
    1: Published(26.67, 0.906, 0.136),
    2: Published(28.77, 0.924, 0.108),
    3: Published(27.66, 0.925, 0.117),
    4: Published(30.06, 0.938, 0.109),
    5: Published(27.78, 0.925, 0.107),
    6: Published(29.79, 0.940, 0.096),
    7: Published(30.59, 0.944, 0.088),
    8: Published(30.81, 0.946, 0.096),
    9: Published(31.01, 0.947, 0.081),
}


def published_for(scene: Scene) -> tuple[str, dict[str, Published]]:
    """Return the name of the paper's dataset that is of a scene's kind, and its numbers; empty where there is none."""
    if scene.synthetic:
        return "Realistic Synthetic 360°", SYNTHETIC
    if scene.ndc is not None:
        return "Real Forward-Facing", FORWARD
    return "", {}
