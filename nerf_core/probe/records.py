"""The records of one opened pixel, as plain arrays. They need numpy only, so that messages can carry them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.methods.stages import Stage
from nerf_core.probe.directions import RadianceProbe
from nerf_core.probe.sightings import Sightings
from nerf_core.probe.standing import Verdict


@dataclass(frozen=True)
class PassProbe:
    """The S samples of one pass along one ray, front to back. See the table in `nerf_core.geometry.rays`.

    name: the pass's name, such as "coarse".
    t: (S,) where the stretch that a sample stands for begins: world distance along the ray.
    until: (S,) where that stretch ends, as a world distance: t + δ, or under NDC the world distance of t′ + δ.
    delta: (S,) the length δ of the stretch, in world units; under NDC in those of NDC.
    sigma: (S,) density σ ≥ 0, per unit of δ.
    alpha: (S,) opacity, 1 − exp(−σδ).
    transmittance: (S,) the share of light that is left in front of the sample.
    weights: (S,) transmittance × alpha.
    rgb: (S, 3) colour in [0, 1], sRGB-encoded.
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


NO_PASS = PassProbe("", *(np.zeros(0, np.float32) for _ in range(7)), rgb=np.zeros((0, 3), np.float32))


WITHOUT_SAMPLES = "the method keeps no samples along a ray: there is no σ, no w and no T, and no verdict"


@dataclass(frozen=True)
class RayProbe:
    """The ray of one pixel with all its samples. Distances are along the ray, in world units.

    step: the training step of the model.
    pixel: integer column and row in the camera's picture.
    origin: (3,) the camera's centre, in world units.
    direction: (3,) unit, from the camera outwards.
    near, far: the bounds of this ray (`nerf_core.geometry.view_rays`), extended to where passes have weight; far is at
        most FARTHEST times the bound.
    passes: coarse before fine. The last one makes the pixel. Empty if the method keeps no samples along a ray.
    color: (3,) composited from the last pass over the background: Σ w c + (1 − Σ w) background (NeRF Eq. 3). Without
        passes it is `rendered_color`.
    opacity: Σ w of the last pass, at most 1; without passes, as it was rendered.
    depth_expected: Σ w t / Σ w; under NDC, the world distance of Σ w t′ / Σ w; without passes, the depth as it was
        rendered. None where the ray hits nothing.
    depth_median: the first sample at which the accumulated weight reaches 0.5. None if it stays under 0.5.
    depth_strongest: the sample with the largest weight. None if no sample has any.
    rendered_color: (3,) the same pixel as the renderer draws it.
    background: (3,) the scene's background colour.
    begins: why the ray begins at `near`, in words.
    visited: (V,) the places that a method without samples looked at, as world distances in the order of the visits.
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
    begins: str = ""
    visited: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def last(self) -> PassProbe:
        """The pass that makes the pixel; one without samples if the method keeps none."""
        return self.passes[-1] if self.passes else NO_PASS

    def point_t(self) -> float:
        """Return the default distance of the ray's point.

        It is the median depth, else the strongest sample, else the rendered depth if there are no samples, else the
        middle between near and far.
        """
        for t in (self.depth_median, self.depth_strongest, None if self.passes else self.depth_expected):
            if t is not None:
                return t
        return (self.near + self.far) / 2


@dataclass(frozen=True)
class Truth:
    """What a photo shows where a ray looks.

    view: the photo, as an index into `Scene.views`.
    pixel: integer column and row in the photo.
    color: (3,) float32, the photo's colour there, in [0, 1].
    """

    view: int
    pixel: tuple[int, int]
    color: np.ndarray


@dataclass(frozen=True)
class RayHistory:
    """How one ray changed over training: N records.

    edges: (BINS + 1,) the edges of the bins, as world distances along the ray.
    steps: (N,) int64, the training step of each record, ascending.
    weights: (N, BINS) Σ w in each bin; NaN if the method keeps no samples along a ray.
    color: (N, 3) the pixel's colour.
    depth: (N,) median depth in world units; without samples, the depth as it was rendered. NaN where there is none.
    opacity: (N,) Σ w.
    """

    edges: np.ndarray
    steps: np.ndarray
    weights: np.ndarray
    color: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray


@dataclass(frozen=True)
class Opened:
    """Everything that is known of one pixel. What is None or empty is not computed yet.

    camera: the camera that has the pixel.
    scene: the scene, whose training photos give the evidence.
    method: the method's name in `METHODS`.
    ray: the samples that make the pixel.
    verdict: what kind of pixel it is, and why.
    radiance: the colours that the ray's point emits. It stays None if the method has no radiance at a point.
    evidence: what the training photos show of the same point.
    walk: the stages from the camera to the loss, with this ray's values.
    name: the name of a pinned ray.
    history: the history of a pinned ray over training.
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
