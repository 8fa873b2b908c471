"""What is known of one opened pixel, as plain arrays: numpy only, so that messages can carry it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.methods.stages import Stage
from nerf_core.probe.directions import RadianceProbe
from nerf_core.probe.sightings import Sightings
from nerf_core.probe.standing import Verdict


@dataclass(frozen=True)
class PassProbe:
    """The samples of one pass along one ray, (S,) each, rgb (S, 3); see `nerf_core.geometry.rays.Samples`.

    until: the distance at which the stretch ends that a sample stands for: t + δ, where δ is of the world.
    """

    name: str
    t: np.ndarray
    until: np.ndarray
    delta: np.ndarray
    sigma: np.ndarray
    alpha: np.ndarray
    transmittance: np.ndarray
    weights: np.ndarray
    rgb: np.ndarray


@dataclass(frozen=True)
class RayProbe:
    """What made one pixel, at training step `step`.

    pixel: integer (column, row) into the camera's image. passes: coarse before fine; the last one made the pixel.
    color: composited from the last pass, background included; rendered_color: the same pixel from the renderer.
    depth_expected: Σwt/Σw (under NDC that of t′, in the world), None where nothing was hit. depth_median: where
    accumulated weight passes 0.5, None where the opacity stays under 0.5. depth_strongest: the sample of largest
    weight, None where none has any. All are distances along the ray.
    near, far: the scene's bounds on this ray; beyond them as far as a pass has weight, but FARTHEST of its bound.
    """

    step: int
    pixel: tuple[int, int]
    origin: np.ndarray
    direction: np.ndarray
    near: float
    far: float
    passes: tuple[PassProbe, ...]
    color: np.ndarray
    opacity: float
    depth_expected: float | None
    depth_median: float | None
    depth_strongest: float | None
    rendered_color: np.ndarray
    background: np.ndarray

    def point_t(self) -> float:
        """Where the ray's point lies unless one is asked for."""
        for t in (self.depth_median, self.depth_strongest):
            if t is not None:
                return t
        return (self.near + self.far) / 2


@dataclass(frozen=True)
class Truth:
    """What a photo shows where a ray looks: view, an index into `Scene.views`; pixel (column, row); color (3,)."""

    view: int
    pixel: tuple[int, int]
    color: np.ndarray


@dataclass(frozen=True)
class RayHistory:
    """steps (N,) int64, ascending. edges (BINS + 1,) world distances. weights (N, BINS): Σ w per bin.

    color (N, 3); depth (N,): median depth, NaN where less than half of the light met anything; opacity (N,).
    """

    edges: np.ndarray
    steps: np.ndarray
    weights: np.ndarray
    color: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray


@dataclass(frozen=True)
class Opened:
    """Everything known of a pixel of `camera`; None, or empty: not yet. evidence is on the point of `radiance`.

    A method that has no radiance at a point leaves `radiance` at None. method: its name. name, history: of a pinned
    ray.
    """

    camera: Camera
    scene: Scene
    method: str
    ray: RayProbe
    verdict: Verdict | None = None
    radiance: RadianceProbe | None = None
    evidence: Sightings | None = None
    walk: tuple[Stage, ...] = ()
    name: str = ""
    history: RayHistory | None = None
