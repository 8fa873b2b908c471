"""Recognise the format of a dataset."""

from __future__ import annotations

from pathlib import Path

from nerf_core.common.assets import assets_dir
from nerf_core.common.errors import UserError
from nerf_core.common.language import phrase
from nerf_core.common.text import counted
from nerf_core.datasets.capture import DATASETS
from nerf_core.datasets.images import SUFFIXES

DEMO = "demo"
CALIBRATIONS = (".json", ".xml", ".csv")


def recognise(path: Path | None, wanted: str) -> tuple[Path, str, tuple[str, ...]]:
    """Return the path to read, the format's name, and notes. Raises UserError that lists the known formats."""
    if wanted != "auto":
        DATASETS.get(wanted)
    if path is None:
        if wanted not in ("auto", DEMO):
            raise UserError(f"--format {wanted} needs a dataset: name its folder")
        return assets_dir() / DEMO, DEMO, ()
    if wanted == DEMO:
        raise UserError(f"--format {DEMO} opens the scene that is installed: leave out {path}")
    if not path.exists():
        raise UserError(f"{path} does not exist: name the folder of a dataset")
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        raise UserError(f"{path} is one photo: name a folder of photos, or a video")
    if not path.is_dir() and path.suffix.lower() not in CALIBRATIONS:
        raise UserError(f"{path} is not a folder: name the folder of a dataset, or its .json, .xml or .csv file")
    if wanted != "auto":
        return path, wanted, ()
    fitting = _fitting(path)
    if not fitting:
        raise UserError(_nothing(path))
    others = ", ".join(fitting[1:])
    if not others:
        return path, fitting[0], ()
    note = phrase("{path} holds {first} and {others}: took {first}; --format chooses",
                  path=path, first=fitting[0], others=others)  # fmt: skip
    return path, fitting[0], (note,)


def _fitting(path: Path) -> list[str]:
    """The names of the formats that match, the preferred one first."""
    return sorted((n for n in DATASETS.names() if DATASETS.get(n).matches(path)), key=lambda n: DATASETS.get(n).rank)


def _nothing(path: Path) -> str:
    known = "; ".join(f"{n} ({DATASETS.get(n).files})" for n in DATASETS.names() if n != DEMO)
    if path.is_file():
        return f"{path} is no video and not a known dataset; name a folder of photos, or one of: {known}"
    inside = [folder for folder in sorted(path.iterdir()) if folder.is_dir()]
    nested = next((folder for folder in inside if _fitting(folder)), None)
    if nested is not None:
        return f"{path} is not a dataset itself, but {nested} is one: open that"
    photos = sum(f.suffix.lower() in SUFFIXES for folder in (path, *inside) for f in folder.iterdir())
    if photos:
        return f"{path} holds {counted(photos, 'photo')} without poses; formats that carry poses: {known}"
    return f"{path} {without_photos(path)}: name a folder of photos, or a video"


def without_photos(folder: Path) -> str:
    """Say what is wrong with a folder that holds neither photos nor a video, or nothing at all."""
    return "holds no photos and no video" if any(folder.iterdir()) else "is an empty folder"
