"""What the training photos show of one point, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

SEEN = 0.5  # a photo sees a point if the transmittance up to it is at least this
FAR_DEGREES = 20.0  # a direction farther than this from every photo was never compared with a photo
FEWEST_LOOKS = 3  # with fewer photos, the part of a colour that does not depend on the view cannot be told


@dataclass(frozen=True)
class Sightings:
    """V training photos that have a world point in their frame.

    Photos that see the point come first; within each group, those nearest in angle to the ray come first.

    point: (3,) in world units.
    margin: half the length of the stretch that counts as the point, in world units.
    asked: the number of training photos.
    framed: how many of them have the point in their frame and not masked. V of these are kept, at most MOST_VIEWS.
    masked: how many have the point in their frame in a masked pixel. They say nothing about it.
    views: (V,) indices into `Scene.views`.
    pixels: (V, 2) column and row of the point in the photo; a pixel's centre lies at +0.5.
    distance: (V,) from the camera to the point, in world units.
    angle: (V,) radians between the camera's direction to the point and the ray's.
    directions: (V, 3) unit, from the point to the camera.
    transmittance: (V,) the model's transmittance from the camera to `margin` in front of the point.
    share: (V,) weight of the stretch of ± `margin` around the point in the photo's pixel.
    observed: (V, 3) the photo's colour in that pixel; with learnt exposures, as the mean exposure would show it.
    gain: (V, 3) the gains of the photo's channels, of learnt exposures; else 1.
    predicted: (V, 3) the model's colour of that pixel.
    emitted: (V, 3) the colour that the point emits towards the camera; NaN if the method has no radiance at a point.
    layer_emitted: (V, 3) the same of the point's layer, if it has one; see `RadianceProbe.layer_rgb`.
    """

    point: np.ndarray
    margin: float
    asked: int
    framed: int
    masked: int
    views: np.ndarray
    pixels: np.ndarray
    distance: np.ndarray
    angle: np.ndarray
    directions: np.ndarray
    transmittance: np.ndarray
    share: np.ndarray
    observed: np.ndarray
    gain: np.ndarray
    predicted: np.ndarray
    emitted: np.ndarray
    layer_emitted: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Whether each photo sees the point, by the model's transmittance: (V,) bool."""
        return self.transmittance >= SEEN

    def at(self, index: np.ndarray) -> Sightings:
        """Return the photos that an index or mask over V chooses."""
        rows = ("point", "margin", "asked", "framed", "masked")
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self) if f.name not in rows})


def mean_emitted(sightings: Sightings, layer: bool = False) -> np.ndarray | None:
    """Return the mean colour that a point, or its layer, emits towards the photos that see it, (3,).

    What a direction emits beside this mean, positive or negative, depends on the view. Directions that no photo
    observed do not count: nothing tells the model what to emit there. None if fewer than FEWEST_LOOKS photos see the
    point, or if the method has no radiance at a point.
    """
    emitted = (sightings.layer_emitted if layer else sightings.emitted)[sightings.seen]
    return emitted.mean(0) if len(emitted) >= FEWEST_LOOKS and not np.isnan(emitted).any() else None


def unseen(directions: np.ndarray, evidence: Sightings | None) -> np.ndarray:
    """Return which directions are farther than FAR_DEGREES from every photo that sees the point.

    Args:
        directions: (K, 3) unit vectors from the point outwards.
        evidence: the photos; None counts as no photos.

    Returns:
        (K,) bool.
    """
    seen = evidence.directions[evidence.seen] if evidence is not None else np.zeros((0, 3))
    if not len(seen):
        return np.ones(len(directions), bool)
    # einsum in place of @: BLAS would wait for threads that training may hold for 20 ms, and the window with it
    cosines = np.einsum("vi,ik->vk", seen.astype(np.float32), np.ascontiguousarray(directions.T, np.float32))
    return cosines.max(0) < np.cos(np.radians(FAR_DEGREES))
