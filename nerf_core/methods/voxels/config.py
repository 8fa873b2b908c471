"""The constants of the voxel method, and how fine its grid becomes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from nerf_core.common.configs import LARGEST, changed, check_ranges, constant, restored
from nerf_core.common.device import machine_memory
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import marked
from nerf_core.geometry.scene import Scene
from nerf_core.geometry.spaces import Space, pixel_size
from nerf_core.kernels.voxel_kernels import MOST_SHARDS
from nerf_core.methods.voxels.sparse_depths import SparseDepths

# What a row takes: 64 bytes for values, average, the copy that a picture is drawn from, and the last good state, 12 for
# moments, and some 12 of its brick. Each thread adds 64 for gradients, and one for marks.
ROW_BYTES, THREAD_BYTES = 280, 65
MEMORY_SHARE = 1 / 4  # of the machine's memory, for a grid of all rows
# With bounded steps and the rates that go with them, lego at 400 × 400 is 0.3 to 0.5 dB worse at equal steps, perhaps
# because each vertex is met by fewer rays. At 200 × 200 it is as good as without. The limit lies between.
MANY_PIXELS = 320
# Of fewer, density learns slowly at first: with it as fast as of many, new views are worse after 600 steps.
FEW_OF_PLACE = 12  # fox is worse with 8 (can is not), and better with 16
FEW_OF_OBJECT = 16  # lego is worse with 12, and better with 16
DEPTH_WEIGHT = 10.0  # of captures with sparse points: better than 0 on each that was tried, or within 0.03 dB of it


@dataclass(frozen=True)
class VoxelConfig:
    """The grid becomes finer level by level, and the photos are shrunk to match it."""

    rays: int = constant(12288, marked("rays per step while the grid is small"), least=1, most=2**22)
    most_rays: int = constant(
        49152, marked("most rays per step: a larger grid has more of them, one for 33 vertices"), least=1, most=2**22
    )
    first_rays: int = constant(
        4096, marked("rays per step in the first level, where no space is known to be empty yet"), least=1, most=2**22
    )
    start: int = constant(40, marked("cells along the box's longest side in the first level"), least=4, most=256)
    pixels: float = constant(
        0.8, marked("side of the finest cells, in pixels of a photo at the scene's centre"), least=0.05, most=10_000
    )
    resolution: int = constant(640, marked("most cells along a side, whatever pixels asks for"), least=1, most=1024)
    planes: int = constant(128, marked("cells in depth under NDC"), least=4, most=1024)
    level_steps: int = constant(
        40, marked("steps of the first level; each further one has twice as many, the last all the rest"), least=1,
        most=10**6,
    )  # fmt: skip
    wait: float = constant(
        2.5, marked("steps before the finest level begins, for each thousand cells of a side of the box"), most=10_000
    )
    most_rows: int = constant(
        6_000_000, marked("most vertices that are stored, 280 bytes each and 65 more per thread"), least=64, most=2**26
    )
    step: float = constant(0.7, marked("length of a sample in cells"), least=0.05, most=16)
    bias: float = constant(-3.0, marked("raw density of a new grid"), least=-LARGEST)
    gloss: float = constant(
        0.3, marked("length of a new grid's vectors of gloss, which brightens all channels alike towards some views"),
        most=3,
    )  # fmt: skip
    rate_color: float = constant(0.5, marked("Adam's learning rate for colour, falling with slowdown and epochs"))
    rate_view: float = constant(0.16, marked("the same for the part of colour that changes with the view"))
    rate_gloss: float = constant(0.06, marked("learning rate of gloss, falling alike"))
    slowdown: float = constant(300.0, marked("rates of colour and gloss fall as 1 / (1 + step / slowdown)"), least=1)
    rate_density: float = constant(
        3.0, marked("Adam's learning rate for density, falling with slowdown_density and epochs")
    )
    slowdown_density: float = constant(
        40.0, marked("the rate of density falls as 1 / (1 + step / slowdown_density)"), least=1
    )
    epochs: float = constant(
        20.0,
        marked(
            "rates also fall as 1 / (1 + (n/epochs)²), to a fifth at most; n: finest level's steps · rays / training "
            "pixels; 0: never"
        ),
        most=10**6,
    )
    epochs_density: float = constant(
        0.0, marked("the same of density instead, without a limit; 0: as the other rates"), most=10**6
    )
    keep_square: float = constant(0.99, marked("Adam's beta2"), share="[0, 1)")
    epsilon: float = constant(1e-5, marked("Adam's epsilon, in units of one ray's gradient"), least=1e-12)
    least_square: float = constant(
        0.25,
        marked(
            "a gradient's square counts in Adam's second moment for this share at least: no step (RMS) is over "
            "rate/√share"
        ),
        most=10**6,
    )
    average: float = constant(
        0.995, marked("decay of the EMA of rows that pictures show; smaller early in training"), share="[0, 1)"
    )
    smoothness: float = constant(3e-5, marked("weight of the smoothness of density in the loss"), most=10**6)
    smoothness_color: float = constant(5e-6, marked("the same of colour"), most=10**6)
    slope: float = constant(
        0.0,
        marked("share with which smoothness counts what is linear in a cell; 0: only the rest costs anything"),
        most=1,
    )
    turn: float = constant(
        1e-4,
        marked("weight in the loss of how normals turn between neighbouring cells, in the last level; 0: off"),
        most=10**6,
    )
    harden: float = constant(
        1.4,
        marked("strength that draws raw density to opaque or clear, in units of its rate, in the last level; 0: off"),
        most=10**3,
    )
    distortion: float = constant(
        5e-3,
        marked("weight of distortion in the loss: it draws the weights along a ray together, out of haze"),
        most=10**6,
    )
    reach: float = constant(
        0.2,
        marked(
            "distortion counts only samples nearer to each other than this: in halves of the box, or folded; 4: all"
        ),
        least=0.01,
        most=10**6,
    )
    distortion_before: float = constant(
        1.0, marked("the same in each level before the last, as a share of that of the level after it"), most=1
    )
    spare: float = constant(
        0.0035, marked("most that a training pixel may lose with dropped cells: under one of 255 levels"), most=1
    )
    spare_error: float = constant(
        2.0, marked("the same in RMS errors of the training pixels, where that is more"),
        most=100,
    )  # fmt: skip
    beside: float = constant(
        0.03,
        marked(
            "weight (by powers of two) that a cell must have in some training pixel for its neighbours to be kept too"
        ),
        least=1e-7,
        most=1,
    )
    split: float = constant(
        0.1,
        marked(
            "weight (by powers of two) that a cell must have in two training photos to be divided at the next level"
        ),
        least=1e-6,
        most=1,
    )
    prune_every: int = constant(
        400, marked("steps of the last level until cells are first dropped; each time twice as many as before"),
        least=1, most=10**6,
    )  # fmt: skip
    depth_weight: float = constant(
        0.0,
        marked("weight of depth in the loss: rays towards sparse points, which their photos see, should end there"),
        most=10**6,
    )
    total_steps: int = constant(
        30_000, marked("steps of the schedule, unless --steps says otherwise"), least=1, most=10**9
    )
    train_images: int = constant(0, marked("training photos that are used, evenly spread; 0: all"), most=10**9)

    def __post_init__(self) -> None:
        check_ranges(self)

    @staticmethod
    def configure(scene: Scene, preset: str, changes: Mapping[str, str], device: torch.device) -> VoxelConfig:
        if preset != "auto":
            raise UserError(f"--preset {shorten(preset)}: method voxels has none but auto; change constants with --set")
        photos = len(scene.trained(changed(VoxelConfig(), changes, "voxels").train_images))
        config = by_kind(scene, photos)
        config = changed(replace(config, most_rows=min(config.most_rows, rows_that_fit())), changes, "voxels")
        if "depth_weight" not in changes and SparseDepths.known(scene, config.train_images):
            config = replace(config, depth_weight=DEPTH_WEIGHT)
        if config.depth_weight > 0:
            SparseDepths.of(scene, config.train_images)
        return config

    @staticmethod
    def restore(config: Mapping[str, Any]) -> VoxelConfig:
        return restored(VoxelConfig, _of_today(config), "voxels")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def by_kind(scene: Scene, photos: int) -> VoxelConfig:
    """Return the constants for an object, an object in large photos, a room, or another place, and so many photos."""
    if scene.synthetic:
        # slopes count, so that surfaces stay soft, and their smoothness is weak
        soft = VoxelConfig(
            smoothness=2.5e-6, smoothness_color=3e-7, slope=1, turn=0, harden=0, reach=4, epochs=0
        )  # fmt: skip
        if pixels_along(scene) > MANY_PIXELS:
            return replace(
                soft, rate_color=0.2, rate_view=0.12, rate_gloss=0.02, rate_density=0.45, slowdown=500,
                slowdown_density=500, least_square=0, smoothness_color=1e-6,
            )  # fmt: skip
        return replace(soft, rate_density=0.6, slowdown_density=300) if photos < FEW_OF_OBJECT else VoxelConfig()
    # a place fills space that is empty around an object, so that each part of it is seen by fewer rays
    place = VoxelConfig(
        rate_color=0.2, rate_view=0.06, rate_gloss=0.04, rate_density=1, slowdown=500, slowdown_density=60,
        keep_square=0.999, least_square=0, smoothness=3e-5, smoothness_color=0, slope=1, turn=0, harden=0,
        distortion=0.01, reach=4, distortion_before=0.3, spare_error=0.5, beside=1e-7, step=1.0, resolution=400,
        most_rows=3_000_000, most_rays=12288, wait=0, epochs=12,
    )  # fmt: skip
    if scene.from_inside:  # walls would be fog: each part of them is seen by few photos, from about one side
        return replace(
            place, rate_gloss=0.01, rate_density=0.45, slowdown_density=500, distortion=0.1, smoothness_color=3e-5
        )
    if photos < FEW_OF_PLACE:
        return replace(place, rate_density=0.2, slowdown_density=500)
    return replace(place, epochs=5, epochs_density=1.5)


def pixels_along(scene: Scene) -> float:
    """Return how many pixels of a photo, at the scene's centre, the box's longest side is long."""
    space = Space.of(scene)
    size = pixel_size(scene, space)  # 0 where a camera stands at the centre
    return float((space.high - space.low).max()) / size if size > 0 else math.inf


def rows_that_fit() -> int:
    """Return how many vertices of a grid take MEMORY_SHARE of this machine's memory."""
    threads = min(torch.get_num_threads(), MOST_SHARDS)
    return max(64, int(MEMORY_SHARE * machine_memory()) // (ROW_BYTES + THREAD_BYTES * threads))


def _of_today(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """A configuration that an earlier version may have written, without what there was and with what there was not."""
    absent = (
        "least_square", "epochs", "epochs_density", "smoothness_color", "turn", "harden", "depth_weight", "gloss",
        "rate_gloss",
    )  # fmt: skip
    older = {
        "distortion_before": 1.0,
        "reach": 4.0,
        "slope": 1.0,
        "slowdown_density": config.get("slowdown"),
        **dict.fromkeys(absent, 0.0),
    }
    config = {**older, "most_rays": config.get("rays"), "wait": 0.0, **config}
    config.pop("keep", None)  # of first moments, which there were
    if "prune" not in config:
        return config
    known = {name: value for name, value in config.items() if name not in ("prune", "growth")}
    new = {"spare": 0.0035, "spare_error": 1.0, "beside": 0.03, "split": 0.1, "distortion": 0.0}
    return {**new, "rate_view": known.get("rate_color"), **known}
