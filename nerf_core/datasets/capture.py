"""The interface of dataset formats: a format returns posed photos as its files state them.

A format is one file in the folder `formats`: a class with the members of `Dataset`, decorated with
`@DATASETS.register(name)`. It reads calibration and poses only. `nerf_core.datasets.load_scene` then loads the photos,
chooses splits and bounds, and normalises the poses, for all formats alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, Protocol

import numpy as np

from nerf_core.common.registry import Registry
from nerf_core.geometry.camera import Camera

HOLD_OUT = 8  # every 8th photo, from the first, is held out if a capture names no splits (LLFF's rule)


Quality = Literal["fast", "normal", "high"]
PoseLens = Literal["perspective", "fisheye"]


@dataclass(frozen=True)
class LoadOptions:
    """The user's choices about loading.

    format: a name of `DATASETS`; "auto" recognises the format by its content.
    downscale: photos are averaged over blocks of downscale × downscale pixels.
    max_size: the limit for the longer side of a photo after that, in pixels; 0: no limit.
    ndc: whether to train in normalised device coordinates; "auto": where that is possible.
    background: the colour behind transparent photos; "auto": white for photos with alpha, else black.
    memory_gb: the limit for all photos together, in memory or in the cache, in 10⁹ bytes; photos are downscaled further
        to fit.
    poses: how carefully the poses of photos are found that have none.
    lens: what took these photos.
    """

    format: str = "auto"
    downscale: int = 1
    max_size: int = 0
    ndc: Literal["auto", "on", "off"] = "auto"
    background: Literal["auto", "white", "black"] = "auto"
    memory_gb: float = 8.0
    poses: Quality = "normal"
    lens: PoseLens = "perspective"


@dataclass(frozen=True)
class Photo:
    """One listed photo that exists as a regular file.

    name: unique in the capture; the path relative to its folder with forward slashes, which may be unprintable.
    camera: calibration and pose in the input's world frame, with OpenGL camera axes. Its pixels are those of the size
        that the input states; where the input states none, of the size that `images.measure` finds in the file.
    mask: the file that says which pixels count, 0 where they do not. None: one of the usual places is looked up.
    upright: whether the camera is certainly that of the photo as its EXIF orientation turns it.
    orientation: the EXIF orientation that the camera's pixels still have; 1: they are upright, as far as is known.
    sighted: (K, 3) sparse points in the input's world frame that the photo certainly sees; None: none are known.
    """

    name: str
    path: Path
    camera: Camera
    mask: Path | None = None
    upright: bool = False
    orientation: int = 1
    sighted: np.ndarray | None = None


@dataclass(frozen=True)
class Depths:
    """The z-depths of a capture's content.

    near, far: all content lies between them, with a margin.
    closest: the depth of the nearest content.
    middle: half of the content is nearer than this.
    """

    closest: float
    near: float
    middle: float
    far: float


@dataclass(frozen=True)
class Capture:
    """The posed photos that a format has read: N photos, P sparse points, lengths in the input's units.

    splits: indices into `photos` by split name ("train", "val", "test"); None: every 8th is test, the rest train.
    near, far: z-depth bounds for all photos; None: derived from bounds_per_photo, depths or points.
    bounds_per_photo: (N, 2) near and far z-depths of each photo, or None.
    depths: those of the capture's depth maps, or None.
    points: (P, 3) sparse points in the input's world frame, or None.
    synthetic: an object rendered on a plain background with known bounds (Blender); its poses are not normalised.
    up: (3,) unit vector in the input's frame if the format defines one; None: derived from the cameras.
    ndc_capable: the format stores forward-facing captures (LLFF), so that `ndc="auto"` takes NDC if the cameras allow.
    reduced: how many times smaller than full size the photos in the folder (images_N) are; `--downscale` counts from
        full size.
    notes: the reader's warnings, one line each.
    landmarks: see `Scene`.
    """

    format: str
    photos: tuple[Photo, ...]
    splits: dict[str, tuple[int, ...]] | None = None
    near: float | None = None
    far: float | None = None
    bounds_per_photo: np.ndarray | None = None
    depths: Depths | None = None
    points: np.ndarray | None = None
    synthetic: bool = False
    up: np.ndarray | None = None
    ndc_capable: bool = False
    reduced: int = 1
    notes: tuple[str, ...] = ()
    landmarks: tuple[tuple[str, float, float], ...] = ()

    def keeping(self, kept: Sequence[int]) -> Capture:
        """Return the capture with only the photos of these indices (ascending). Splits and bounds are adapted."""
        place = {old: new for new, old in enumerate(kept)}
        splits = self.splits and {k: tuple(place[i] for i in v if i in place) for k, v in self.splits.items()}
        bounds = None if self.bounds_per_photo is None else self.bounds_per_photo[list(kept)]
        return replace(self, photos=tuple(self.photos[i] for i in kept), splits=splits, bounds_per_photo=bounds)

    def named_splits(self) -> dict[str, tuple[int, ...]]:
        """Return the capture's splits; without any, every 8th photo is test. A single photo is always in train."""
        if self.splits is not None:
            return self.splits
        every = range(len(self.photos))
        if len(every) == 1:
            return {"train": (0,)}
        return {"train": tuple(i for i in every if i % HOLD_OUT), "test": tuple(every[::HOLD_OUT])}


class Dataset(Protocol):
    """A dataset format. A path is a folder, or a .json, .xml or .csv file inside one.

    rank: of all formats that match, `auto` takes the lowest.
    files: the files of this format, for messages ("poses_bounds.npy with images").
    """

    rank: ClassVar[int]
    files: ClassVar[str]

    @staticmethod
    def matches(path: Path) -> bool:
        """Return whether files of this format are there. It looks at names and first bytes, and never raises."""
        ...

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read calibration and poses of all photos that exist. Raises UserError that names file, field and remedy."""
        ...


DATASETS: Registry[type[Dataset]] = Registry(
    "dataset format", "nerf_core.datasets.formats", entry_points="nerf_viewer.datasets"
)
