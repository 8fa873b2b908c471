"""COLMAP's sparse models: several cameras, portrait and landscape photos, perspective and fisheye lenses, points."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import ClassVar

import numpy as np

from nerf_core.common import cache
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.json_files import read_json
from nerf_core.common.language import phrase
from nerf_core.common.subprograms import run_limited
from nerf_core.datasets.capture import DATASETS, Capture, LoadOptions, Photo
from nerf_core.datasets.colmap_files import AGAIN, check_model, find_models, image_count, photo_names
from nerf_core.datasets.photo_folders import PhotoFolder, choose_folder, photo_folders, photos_below
from nerf_core.datasets.photo_paths import find_photos, photo_name
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import FISHEYE, PERSPECTIVE, Lens

READ_SECONDS = 60.0  # a model of ten thousand photos takes about twenty
LENSES = {  # {camera model: its parameters in COLMAP's order}; f stands for both focal lengths
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}
LIMIT = 1e12  # beyond any unit of length
GOOD_TRACK = 3  # photos that see a point: if only two do, its depth is often wrong
ENOUGH_POINTS = 100
NOT_OF_PHOTOS = ("points", "tracks", "sighting_images", "sighting_points")
Model = dict[str, np.ndarray]


@DATASETS.register("colmap")
class Colmap:
    """Photos without a pose are left out, with a note. Of several models the one with most photos is read."""

    rank: ClassVar[int] = 2
    files: ClassVar[str] = "sparse/0 with cameras, images and points3D"

    @staticmethod
    def matches(path: Path) -> bool:
        return path.is_dir() and bool(find_models(path))

    @staticmethod
    def read(path: Path, options: LoadOptions) -> Capture:
        """Read the photos sorted by name, their poses in OpenGL axes, and the sparse points. Raises UserError."""
        root = path if path.is_dir() else path.parent
        folder, notes = _largest(root)
        model = read_model(folder)
        names = [str(name) for name in model["names"]]
        cameras = [_camera(model, i, folder) for i in range(len(names))]
        place, photo_notes = _photo_folder(root, folder, names, options.downscale)
        found = find_photos(place.path, names, folder)
        upright = _of_upright_photos(root)
        home = place.path.parent if place.path != root else root
        return Capture(
            format="colmap",
            photos=tuple(
                Photo(photo_name(home, file), file, camera, upright=upright, sighted=sighted)
                for file, camera, sighted in zip(found.paths, cameras, _sighted(model), strict=True)
                if file is not None
            ),
            points=_good_points(model),
            reduced=place.reduced,
            notes=(*notes, *photo_notes, *found.notes),
        )


def _of_upright_photos(root: Path) -> bool:
    """Whether the model is of photos turned by their EXIF orientation: `nerf-core pose` says so in poses.json."""
    file = root / "poses.json"
    try:
        return file.exists() and read_json(file).values.get("upright") is True
    except (OSError, UserError):
        return False


def _largest(root: Path) -> tuple[Path, tuple[str, ...]]:
    models = find_models(root)
    if not models:
        raise UserError(
            f"{root} has no COLMAP model: sparse/0 with cameras, images and points3D (.bin or .txt) is needed"
        )
    counts = [image_count(model) for model in models]
    best = models[counts.index(max(counts))]
    if len(models) == 1:
        return best, ()
    others = ", ".join(f"{m.name} {n}" for m, n in zip(models, counts, strict=True) if m != best)
    note = phrase(
        "{folder} holds {count} models: took {name} with {photos} photos ({others})",
        folder=best.parent,
        count=len(models),
        name=best.name,
        photos=max(counts),
        others=others,
    )
    return best, (note,)


def read_model(folder: Path) -> Model:
    """Read a model with pycolmap in a separate process (`colmap_reader`), within READ_SECONDS.

    Raises UserError for damaged models, and if pycolmap is not installed.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise UserError(f"{folder} is a COLMAP model: to read it, run `pip install pycolmap`")
    check_model(folder)
    program = Path(__file__).parents[1] / "colmap_reader.py"
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "model.npz"
        # -P: the program lies in this package's folder, whose files must not be imported as top-level modules
        command = [sys.executable, "-P", str(program), str(folder.resolve()), str(out)]
        try:
            done = run_limited(command, READ_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise UserError(f"{folder} was not read within {READ_SECONDS:g} s, it may be damaged: {AGAIN}") from error
        if done.reason:
            raise UserError(f"{folder}: pycolmap cannot read the model ({shorten(done.reason, 200)}): {AGAIN}")
        with np.load(out, allow_pickle=False) as arrays:
            model = {name: arrays[name] for name in arrays.files}
    if not len(model["ids"]):
        raise UserError(f"{folder} has no photo with a pose: run COLMAP's mapper first")
    return _by_name(model, folder)


def _by_name(model: Model, folder: Path) -> Model:
    """The model with the names of its photos, sorted by them."""
    names = photo_names(folder)
    model["names"] = np.array([names[image] for image in model["ids"].tolist()])
    order = np.argsort(model["names"], kind="stable")
    return {name: v if name in NOT_OF_PHOTOS else v[order] for name, v in model.items()}


def _camera(model: Model, index: int, folder: Path) -> Camera:
    """Convert world-to-camera in OpenCV axes (y down, z forward) to camera-to-world in OpenGL axes."""
    photo, kind = shorten(str(model["names"][index])), str(model["models"][index])
    if kind not in LENSES:
        raise UserError(
            f"{folder}: photo {photo} has the camera model {kind}; known are {', '.join(LENSES)}: undistort the photos "
            "with COLMAP's image_undistorter and open its result"
        )
    values = dict(zip(LENSES[kind], map(float, model["parameters"][index]), strict=False))
    focal = values.pop("f", 1.0)
    fx, fy = values.pop("fx", focal), values.pop("fy", focal)
    width, height = model["sizes"][index]
    pose = model["poses"][index]
    numbers = np.array([width, height, fx, fy, *values.values(), *pose.ravel()])
    if not (np.abs(numbers) <= LIMIT).all() or min(width, height) < 1 or min(fx, fy) < 1e-4 * width:
        raise UserError(
            f"{folder}: photo {photo} of {width:g}×{height:g} pixels has the focal lengths {fx:g}, {fy:g} or values "
            f"that are not numbers: {AGAIN}"
        )
    rotation = pose[:, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
        raise UserError(f"{folder}: the pose of photo {photo} is not a rotation: {AGAIN}")
    c2w = np.column_stack([rotation.T * (1, -1, -1), -rotation.T @ pose[:, 3]])
    cx, cy = values.pop("cx"), values.pop("cy")
    lens = Lens(**values, kind=FISHEYE if kind.endswith("FISHEYE") else PERSPECTIVE)
    return Camera(int(width), int(height), fx, fy, cx, cy, c2w, lens)


def _photo_folder(root: Path, model: Path, names: Sequence[str], downscale: int) -> tuple[PhotoFolder, tuple[str, ...]]:
    """Find the photos: in images or images_N beside the model or up to two folders above it, else in `root`."""
    homes = [root, root.parent, root.parent.parent] if model == root else [root]
    folders = next((found for home in homes if (found := photo_folders(home))), ())
    if not folders:
        return PhotoFolder(root, 1, photos_below(root)), ()
    wanted = {PurePosixPath(name).with_suffix("") for name in names}

    def present(folder: PhotoFolder) -> int:
        return len(
            wanted & {PurePosixPath(f.relative_to(folder.path).as_posix()).with_suffix("") for f in folder.files}
        )

    chosen, notes = choose_folder(folders, downscale, len(wanted), present)
    if len(chosen.files) > len(names) and not cache.holds("poses", root):  # who found those poses says what each lacks
        notes += (
            phrase(
                "{count} of the {total} photos in {folder} are registered; the others have no pose",
                count=len(names),
                total=len(chosen.files),
                folder=chosen.path,
            ),
        )
    return chosen, notes


def _good_points(model: Model) -> np.ndarray | None:
    """The points that three or more photos see, if there are enough, else all; None if there are no points."""
    points, tracks = model["points"], model["tracks"]
    sane = (np.abs(points) <= LIMIT).all(axis=1)
    good = sane & (tracks >= GOOD_TRACK)
    chosen = points[good if good.sum() >= ENOUGH_POINTS else sane]
    return chosen if len(chosen) else None


def _sighted(model: Model) -> list[np.ndarray | None]:
    """For each photo the reliable points (K, 3) that it sees; None if it sees none."""
    points, by, seen = model["points"], model["sighting_images"], model["sighting_points"]
    sane = (np.abs(points[seen]) <= LIMIT).all(axis=1)
    order = np.argsort(by[sane], kind="stable")
    by, seen = by[sane][order], seen[sane][order]
    first, last = (np.searchsorted(by, model["ids"], side) for side in ("left", "right"))
    return [points[seen[a:b]] if b > a else None for a, b in zip(first.tolist(), last.tolist(), strict=True)]
