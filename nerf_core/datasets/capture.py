"""What a dataset format hands over: posed photos as the files state them, nothing loaded, nothing normalised.

A format is one file of this folder: a class with the members of `Dataset`, decorated with
`@DATASETS.register(name)`. It reads calibration and poses; photos, splits by the field's rule, bounds and
normalisation are done for all formats by `nerf_core.datasets.load_scene`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal, Protocol

import numpy as np

from nerf_core.common.registry import Registry
from nerf_core.geometry.camera import Camera

HOLD_OUT = 8  # every 8th photo, from the first, is held out where a capture names no splits (LLFF's rule)


@dataclass(frozen=True)
class LoadOptions:
    """What the user may decide about loading.

    format: a name of `DATASETS`, or "auto": recognised by content. downscale: photos are averaged over blocks of
    downscale × downscale pixels. max_size: the longer side of a photo afterwards, in pixels; 0: as it is.
    ndc: whether to train in normalised device coordinates; auto: where that is possible. background: what
    transparent photos are composited over; auto: white for photos with alpha, else black.
    memory_gb: what all loaded photos together may take, in 10⁹ bytes; they are downscaled further to fit.
    """

    format: str = "auto"
    downscale: int = 1
    max_size: int = 0
    ndc: Literal["auto", "on", "off"] = "auto"
    background: Literal["auto", "white", "black"] = "auto"
    memory_gb: float = 8.0


@dataclass(frozen=True)
class Photo:
    """One listed photo that exists as a regular file.

    name: unique in the capture, the path relative to its folder with forward slashes.
    camera: its calibration in pixels of the size that the *input* states (`images.measure` gives the file's own
    size where the input states none), with its pose in the input's world frame; OpenGL camera axes.
    """

    name: str
    path: Path
    camera: Camera


@dataclass(frozen=True)
class Capture:
    """Posed photos as read by one format; P sparse points, N photos; lengths in the input's units.

    splits: indices into `photos` by split name ("train", "val", "test"); None: every 8th is test, the rest train.
    near, far: z-depth bounds that hold for all photos. bounds_per_photo: (N, 2) near and far z-depths of each.
    points: (P, 3) sparse points in the input's world frame. Whatever of these is None is to be derived.
    synthetic: an object rendered on nothing, with known bounds (Blender): poses keep their frame and scale.
    up: (3,) unit vector in the input's frame where the format defines one; None: derived from the cameras.
    ndc_capable: the format stores forward-facing captures (LLFF), so that `ndc="auto"` may take NDC if the
    cameras allow it. reduced: how many times smaller than full size the photos' folder (images_N) holds them;
    `--downscale` counts from full size. notes: what the reader warns about, one line each.
    """

    format: str
    photos: tuple[Photo, ...]
    splits: dict[str, tuple[int, ...]] | None = None
    near: float | None = None
    far: float | None = None
    bounds_per_photo: np.ndarray | None = None
    points: np.ndarray | None = None
    synthetic: bool = False
    up: np.ndarray | None = None
    ndc_capable: bool = False
    reduced: int = 1
    notes: tuple[str, ...] = ()

    def keeping(self, kept: Sequence[int]) -> Capture:
        """The capture with only the photos of these (ascending) indices; splits and bounds follow."""
        place = {old: new for new, old in enumerate(kept)}
        splits = self.splits and {k: tuple(place[i] for i in v if i in place) for k, v in self.splits.items()}
        bounds = None if self.bounds_per_photo is None else self.bounds_per_photo[list(kept)]
        return replace(self, photos=tuple(self.photos[i] for i in kept), splits=splits, bounds_per_photo=bounds)

    def named_splits(self) -> dict[str, tuple[int, ...]]:
        """The capture's own splits, else every 8th photo as test; a single photo is trained on."""
        if self.splits is not None:
            return self.splits
        every = range(len(self.photos))
        if len(every) == 1:
            return {"train": (0,)}
        return {"train": tuple(i for i in every if i % HOLD_OUT), "test": tuple(every[::HOLD_OUT])}


class Dataset(Protocol):
    """A format. Paths are a folder, or a .json file that lies in one.

    rank: `auto` prefers the lowest among the formats that match. files: what a folder of the format holds, for
    messages ("poses_bounds.npy with images").
    """

    rank: ClassVar[int]
    files: ClassVar[str]

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether files of this format are there: cheap, by names and first bytes, raising nothing."""
        ...

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Calibration and poses of all photos that exist. Raises UserError naming file, field and remedy."""
        ...


DATASETS: Registry[type[Dataset]] = Registry(
    "dataset format", "nerf_core.datasets.formats", entry_points="nerf_viewer.datasets"
)
