"""Training photos that have a point in their frame: what they show of it, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

SEEN = 0.5  # transmittance up to a point from which on a photo is said to see it
FAR_DEGREES = 20.0  # from the nearest photo: what the model says there was never compared with anything
FEWEST_LOOKS = 3  # with fewer one cannot tell what stays the same from all sides


@dataclass(frozen=True)
class Sightings:
    """V training photos that have a world point in their frame, the clearest and then the nearest in angle first.

    point: (3,). framed: how many have it in their frame, of `asked` training photos; V of them were looked at.
    views: (V,) into `Scene.views`. pixels: (V, 2) where the point lies in the photo, in pixels; what follows is of the
    pixel that holds it. distance: (V,). angle: (V,) radians between that look at the point and the ray's.
    directions: (V, 3) unit, from the point to the camera. transmittance: (V,) of the model, from the camera up to
    `margin` before the point; share: (V,) what the stretch of ± `margin` around the point weighs in that pixel.
    observed, predicted: (V, 3) the photo's colour and the model's. emitted: (V, 3) what the point emits that way;
    NaN if the method has no radiance at a point.
    """

    point: np.ndarray
    margin: float
    asked: int
    framed: int
    views: np.ndarray
    pixels: np.ndarray
    distance: np.ndarray
    angle: np.ndarray
    directions: np.ndarray
    transmittance: np.ndarray
    share: np.ndarray
    observed: np.ndarray
    predicted: np.ndarray
    emitted: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(V,) bool: whether the photo sees the point, as the model has it."""
        return self.transmittance >= SEEN

    def at(self, index: np.ndarray) -> Sightings:
        """Those of an index or mask over V."""
        rows = ("point", "margin", "asked", "framed")
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self) if f.name not in rows})


def diffuse_of(sightings: Sightings) -> np.ndarray | None:
    """What a point emits towards everybody: per channel the least that it shows any photo that sees it, (3,).

    The rest of its colour is specular: it is added, and depends on the view. None where fewer than FEWEST_LOOKS see it.
    """
    emitted = sightings.emitted[sightings.seen]
    return emitted.min(0) if len(emitted) >= FEWEST_LOOKS and not np.isnan(emitted).any() else None


def unseen(directions: np.ndarray, evidence: Sightings | None) -> np.ndarray:
    """Which directions (K, 3), from a point outwards, lie farther than FAR_DEGREES from any photo's."""
    seen = evidence.directions[evidence.seen] if evidence is not None else np.zeros((0, 3))
    if not len(seen):
        return np.ones(len(directions), bool)
    # Not @, whose BLAS waits for threads that training may hold for 20 ms, and a window for it
    cosines = np.einsum("vi,ik->vk", seen.astype(np.float32), np.ascontiguousarray(directions.T, np.float32))
    return cosines.max(0) < np.cos(np.radians(FAR_DEGREES))
