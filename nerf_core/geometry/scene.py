"""A loaded capture: posed photos, bounds, and the transform back to the input's frame."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from nerf_core.common.errors import shorten
from nerf_core.common.language import marked
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.coverage import Coverage
from nerf_core.geometry.ndc import Ndc
from nerf_core.geometry.photos import Photos

SPLITS = ("train", "val", "test")
IDENTITY = 2  # how `Scene.identity` is made; 1: of exact numbers
LARGE_IDENTITY = 3  # that of a large capture: the sizes of the files stand for pixels, which are not there yet
DECIMALS = 6  # poses and bounds are some units: far more than rounding errors, far less than any real difference
INSIDE = 0.75  # fewer of the photos look towards the scene's centre if they look outwards; of an orbit, all do


@dataclass(frozen=True)
class View:
    """One posed photo.

    name: unique in the scene: the path relative to its folder as `printable` shows it, as metrics report it.
    sighted: (K, 3) float32 sparse points in scene units that the photo certainly sees; None: none are known. They are
        no part of the scene's identity.
    """

    name: str
    camera: Camera
    sighted: np.ndarray | None = None


@dataclass(frozen=True, repr=False)
class Scene:
    """Posed photos in the trainer's frame. It is frozen, so that threads can share it.

    name: the name of the capture's folder as `printable` shows it; "demo" for the demo scene.
    format: a name of `DATASETS`.
    views: names and cameras of the photos.
    photos: one per view, sRGB-encoded, 65535 = 1, composited over `background`. 16 bits hold 8-bit and 16-bit photos
        exactly, and averaged ones without visible error; photos that are all of 8 bits are kept in 8.
    splits: indices into `views` for each name of SPLITS that the capture has.
    near, far: the z-depths (along the optical axis, not the ray) that enclose the content, in scene units. For cameras
        with a wide lens they are distances.
    background: the colour behind the content, in [0, 1], sRGB-encoded.
    center, radius, up: the centre (3,), radius and axis (3,) of an orbit, in scene units.
    to_input: (4, 4) similarity from scene points to the frame of the input files.
    disparity: whether samples are spaced linearly in 1/z (real captures without NDC).
    synthetic: whether it is an object on a plain background (Blender's format), not photos of a place.
    ndc: the reference frustum if the scene is trained in normalised device coordinates, else None.
    notes: the reader's warnings, one line each.
    posed: how well its poses were found, in a line; empty: they came with the capture.
    landmarks: rays worth watching from the first step: a name, and a position (x, y) in the first training photo, as
        shares of its width and height.
    points: (P, 3) float32 some of the capture's sparse points in scene units; None: it has none.
    """

    name: str
    format: str
    views: tuple[View, ...]
    photos: Photos
    splits: dict[str, tuple[int, ...]]
    near: float
    far: float
    background: tuple[float, float, float]
    center: np.ndarray
    radius: float
    up: np.ndarray
    to_input: np.ndarray
    disparity: bool = False
    synthetic: bool = False
    ndc: Ndc | None = None
    notes: tuple[str, ...] = ()
    landmarks: tuple[tuple[str, float, float], ...] = ()
    posed: str = ""
    points: np.ndarray | None = None

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, {self.format}: {self.summary()})"

    @property
    def images(self) -> Sequence[np.ndarray]:
        """The photos of all views, uint16 (H, W, 3)."""
        return self.photos.images

    def split(self, name: str) -> tuple[int, ...]:
        """Return the indices of the views in a split; empty if the capture does not have it."""
        return self.splits.get(name, ())

    def trained(self, count: int) -> tuple[int, ...]:
        """Return the views of `count` training photos, evenly spread; 0 or too many: of all."""
        views = self.split("train")
        if not 0 < count < len(views):
            return views
        return tuple(views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int))

    @cached_property
    def from_inside(self) -> bool:
        """Whether training photos look outwards, as in a room: over a quarter have the scene's centre behind them."""
        poses = self.poses[list(self.split("train"))]
        ahead = ((self.center - poses[:, :, 3]) * -poses[:, :, 2]).sum(1) > 0
        return self.ndc is None and bool(ahead.sum() < INSIDE * len(ahead))

    def held_out(self) -> tuple[str, tuple[int, ...]]:
        """Return the split that evaluation uses by default (test, else val) and its views."""
        for name in ("test", "val"):
            if self.split(name):
                return name, self.split(name)
        return "test", ()

    @cached_property
    def coverage(self) -> Coverage:
        """The space that training rays cross."""
        cameras = [self.views[i].camera for i in self.split("train")]
        return Coverage.of(cameras, self.near, self.far, self.center, self.radius)

    @cached_property
    def poses(self) -> np.ndarray:
        """The poses of all cameras, (N, 3, 4)."""
        return np.array([view.camera.c2w for view in self.views], dtype=np.float64).reshape(-1, 3, 4)

    @cached_property
    def photo_sizes(self) -> list[tuple[int, int]]:
        """The sizes (width, height) that photos have, each once, sorted."""
        return sorted({(view.camera.width, view.camera.height) for view in self.views})

    def owns(self, camera: Camera) -> bool:
        """Return whether a camera stands where one of the capture's cameras stood, and looks the same way."""
        return bool((self.poses == camera.c2w).all((1, 2)).any())

    def reposed(self, poses: Mapping[int, np.ndarray]) -> Scene:
        """Return the scene with other poses (3, 4) of some views."""
        views = list(self.views)
        for i, c2w in poses.items():
            views[i] = replace(views[i], camera=views[i].camera.moved(c2w))
        return replace(self, views=tuple(views))

    def unsighted(self) -> Scene:
        """Return the scene without the sparse points: they were placed with poses that are doubted."""
        return replace(self, views=tuple(replace(view, sighted=None) for view in self.views))

    def summary(self) -> str:
        """Describe in words what the loading options decide."""
        sizes = self.photo_sizes
        size = f"{sizes[0][0]:,}×{sizes[0][1]:,}" + (f" to {sizes[-1][0]:,}×{sizes[-1][1]:,}" if sizes[1:] else "")
        counts = ", ".join(f"{len(indices):,} {name}" for name, indices in self.splits.items())
        ground = ", ".join(f"{channel:g}" for channel in self.background)
        return f"photos of {size} pixels ({counts}){', NDC' if self.ndc else ''}, background {ground}"

    def difference(self, description: Mapping[str, Any]) -> str:
        """Return the end of an error message: how this scene differs from a checkpoint's, and what to do."""
        name, there, here = description["scene_name"], description["scene_summary"], self.summary()
        if there == here:
            if name == self.name:
                return (
                    f"trained on {shorten(name)} with other photos, poses or bounds: open it as it was then, or train "
                    "again if its poses were found anew"
                )
            return f"trained on {shorten(name)}, whose photos, poses or bounds differ from {self.name}'s: open that one"
        advice = "open that one"
        if name == self.name:
            advice = "open it as it was then (--downscale, --max-size, --format, …)"
        return f"trained on {shorten(name)}, {shorten(there, 160)}; open now is {self.name}, {here!r}: {advice}"

    def identity(self) -> str:
        """Return a hash of poses, intrinsics, bounds, names, splits and a few pixels of each photo, for checkpoints.

        Of a large capture, whose photos may still be read, it has the sizes of their files in place of pixels. Masks
        are left out, so that runs of versions without masks can go on.
        Numbers are rounded to DECIMALS: processors differ in the last digits of a matrix product.
        """
        return self._hash(lambda number: round(float(number), DECIMALS) + 0.0)  # −0 becomes 0

    @property
    def identity_kind(self) -> int:
        """How `identity` is made: IDENTITY or LARGE_IDENTITY."""
        return IDENTITY if self.photos.filling is None else LARGE_IDENTITY

    def is_of(self, description: Mapping[str, Any]) -> bool:
        """Return whether a checkpoint was trained on this scene, as far as can be known.

        A checkpoint of an earlier `identity_kind` has another hash: of exact numbers, or of pixels that are not there.
        Where it differs, the name and the summary decide; see `doubt`.
        """
        if description["scene"] == self.identity():
            return True
        if description.get("scene_identity", 1) >= self.identity_kind:
            return False
        alike = (description["scene_name"], description["scene_summary"]) == (self.name, self.summary())
        return alike or not self.doubt(description)

    def doubt(self, description: Mapping[str, Any]) -> str:
        """Return a warning if it cannot be known whether a checkpoint for which `is_of` holds is of this scene."""
        if description.get("scene_identity", 1) >= self.identity_kind:
            return ""
        if self.photos.filling is not None:
            return marked("an earlier version wrote the checkpoint: its photos and poses are not compared")
        if description["scene"] == self._hash(lambda number: number):
            return ""
        return marked(
            "an earlier version wrote the checkpoint, perhaps on another processor: its poses are not compared"
        )

    def _hash(self, number: Callable[[float], float]) -> str:
        digest, ndc = hashlib.sha256(), self.ndc
        bounds = number(self.near), number(self.far), tuple(number(channel) for channel in self.background)
        if ndc is not None:
            ndc = replace(ndc, focal=number(ndc.focal), near=number(ndc.near), far=number(ndc.far))
        digest.update(repr((*bounds, self.disparity, ndc)).encode())
        digest.update(repr(sorted((k, tuple(v)) for k, v in self.splits.items())).encode())
        for k, (view, (width, height)) in enumerate(zip(self.views, self.photos.sizes.tolist(), strict=True)):
            digest.update(view.name.encode())
            digest.update(repr(tuple(number(v) for v in _described(view.camera))).encode())
            c2w = [[number(v) for v in row] for row in view.camera.c2w.tolist()]
            digest.update(np.array(c2w, dtype="<f8").tobytes())
            if self.photos.filling is not None and self.photos.ids is not None:
                digest.update(repr(int(self.photos.filling.bytes[self.photos.ids[k]])).encode())
                continue
            sparse = self.photos.part(
                k, slice(None, None, max(1, height // 16)), slice(None, None, max(1, width // 16))
            )
            digest.update(np.ascontiguousarray(sparse).tobytes())
        return digest.hexdigest()


def _described(camera: Camera) -> tuple[float, ...]:
    """The camera's intrinsics as a hash has them: only the first 11 where the others are 0, as in earlier versions."""
    numbers = camera.intrinsics()
    return numbers if any(numbers[11:]) else numbers[:11]
