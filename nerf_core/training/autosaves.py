"""Checkpoints that the user named no file for: where they go, what is there, and how to continue from them."""

from __future__ import annotations

import json
import os
import re
import tempfile
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerf_core.common.errors import UserError
from nerf_core.common.files import clear_leftovers
from nerf_core.common.json_files import Fields
from nerf_core.common.names import printable
from nerf_core.datasets import LoadOptions
from nerf_core.geometry.scene import Scene
from nerf_core.training.checkpoint import SUFFIX, describe, own_texts, tensor
from nerf_core.training.settings import filled

if TYPE_CHECKING:
    from torch import Tensor

MOST_NAME_BYTES = 100  # of a scene's name in a file's: systems take 255 bytes, and others are added
AUTOSAVE = re.compile(rf".+-([0-9a-f]{{8}})-\d{{8}}-\d{{6}}-\d+{re.escape(SUFFIX)}")  # a name that `spare_files` gives
PICTURE = "picture"  # the tensor with a small picture of the run
PICTURE_SIDE = 320  # its longer side in pixels: enough for a list, also on a screen of scale 2
FIELD = "left_off"  # of the description: what opens the scene again


@dataclass(frozen=True)
class Autosave:
    """One autosave, as far as its header tells.

    file: the checkpoint.
    bytes: its size.
    saved: when, in seconds since 1970.
    scene: the scene's name, printable; empty if the file cannot be read.
    method: the name of the method.
    step: the training step.
    seconds: of training.
    capture: the capture's folder or file; None: the demo scene, or not known.
    load: the options with which the capture was loaded; None: not known.
    problem: why the run cannot be continued from here; empty if it can, as far as is known.
    """

    file: Path
    bytes: int
    saved: float
    scene: str = ""
    method: str = ""
    step: int = 0
    seconds: float = 0.0
    capture: Path | None = None
    load: LoadOptions | None = None
    problem: str = ""


# ---- where they go ----------------------------------------------------------------------------------------------


def autosave_folder() -> Path | None:
    """Return the folder for checkpoints that the user named no file for; None without platformdirs."""
    try:
        import platformdirs
    except ImportError:  # on a machine with only what training needs
        return None
    return Path(platformdirs.user_data_dir("nerf-viewer")) / "autosave"


def autosave_prefix(scene: Scene) -> str:
    """Return how the names of a scene's autosaves begin. It is at most MOST_NAME_BYTES + 9 bytes long."""
    return f"{_stem(scene)}-{scene.identity()[:8]}"


def checkpoint_name(scene: Scene) -> str:
    """Return the name of a checkpoint that the user did not name, in a folder that is the user's own."""
    return f"{_stem(scene)}{SUFFIX}"


def spare_files(scene: Scene) -> list[Path]:
    """Return new files for a scene's weights, the better ones first: among the user's data, and a temporary one."""
    name = f"{autosave_prefix(scene)}-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}{SUFFIX}"
    return [folder / name for folder in _spare_folders()]


def clear_spare_leftovers() -> None:
    """Delete what killed processes left half written in the folders of `spare_files`."""
    for folder in _spare_folders():
        clear_leftovers(folder)


def _stem(scene: Scene) -> str:
    name = re.sub(r"[^\w.-]+", "-", scene.name).strip(".-").encode(errors="replace")[:MOST_NAME_BYTES]
    return name.decode(errors="ignore") or "scene"


def _spare_folders() -> list[Path]:
    folders = [autosave_folder()]
    with suppress(OSError):  # no folder for temporary files can be written
        # no folder of its own below it: the first user's could not be written by others
        folders.append(Path(tempfile.gettempdir()))
    return [folder for folder in folders if folder is not None]


# ---- what they hold besides a model -----------------------------------------------------------------------------


def left_off(file: Path, capture: Path | None, load: LoadOptions) -> dict[str, Any]:
    """Return what an autosave's description also has: what opens its scene again.

    Args:
        file: where the checkpoint goes. Only an autosave has it: the user's own file may be given to others, whom the
            paths of this computer do not concern.
        capture: the capture's folder or file, absolute; None: the demo scene.
        load: the options with which it was loaded.

    Returns:
        JSON values by name.
    """
    if not AUTOSAVE.fullmatch(file.name):
        return {}
    return {FIELD: {"capture": None if capture is None else str(capture), "load": asdict(load)}}


def small_picture(file: Path, rgba: np.ndarray | None) -> dict[str, Tensor]:
    """Return the tensor with which an autosave keeps a picture of the run.

    Args:
        file: where the checkpoint goes; see `left_off`.
        rgba: uint8 (h, w, 4), or None.

    Returns:
        By its name, uint8 (h, w, 3) of at most PICTURE_SIDE pixels a side; nothing without a picture.
    """
    if rgba is None or not AUTOSAVE.fullmatch(file.name):
        return {}
    import torch

    high, wide = rgba.shape[:2]
    scale = min(PICTURE_SIDE / max(high, wide), 1.0)
    rows, columns = max(round(scale * high), 1), max(round(scale * wide), 1)
    color = torch.from_numpy(np.ascontiguousarray(rgba[..., :3])).permute(2, 0, 1).float()
    small = torch.nn.functional.interpolate(color[None], (rows, columns), mode="area")[0]
    return {PICTURE: small.round().to(torch.uint8).permute(1, 2, 0).contiguous()}


def picture(file: Path) -> np.ndarray | None:
    """Read the picture of an autosave: uint8 (h, w, 4). None: it has none, or what it has is damaged."""
    found = tensor(file, PICTURE)
    if found is None or found.dtype != np.uint8 or found.ndim != 3 or found.shape[2] != 3:
        return None
    if not 1 <= min(found.shape[:2]) <= max(found.shape[:2]) <= PICTURE_SIDE:
        return None
    return np.concatenate([found, np.full((*found.shape[:2], 1), 255, np.uint8)], axis=2)


# ---- what is there ----------------------------------------------------------------------------------------------


def any_autosave() -> bool:
    """Return whether there is an autosave. It reads no more headers than until the first."""
    return any(_is_own(file) for file in _named())


def autosaves() -> list[Autosave]:
    """Return all autosaves, the newest first. Only their headers are read."""
    found = [_entry(file) for file in _named() if _is_own(file)]
    return sorted(filter(None, found), key=lambda one: one.saved, reverse=True)


def clear(entries: Iterable[Autosave]) -> tuple[list[Autosave], list[str]]:
    """Delete autosaves. A file stays if another program has replaced it meanwhile.

    Args:
        entries: those of `autosaves()`, or some of them.

    Returns:
        What was deleted, and why each of the others was not.
    """
    deleted, reasons = [], []
    for one in entries:
        try:
            if _is_own(one.file):
                one.file.unlink()
                deleted.append(one)
        except OSError as error:
            reasons.append(f"{one.file}: cannot be deleted ({error.strerror or error})")
    return deleted, reasons


def forget_old_autosaves(scene: Scene, count: int) -> None:
    """Delete autosaves of a scene: all but the newest `count` and the one that was trained the longest.

    Some short looks at a scene thus cost no long training. A file stays if it has another name than autosaves have, or
    is no checkpoint of the scene: it is the user's own.
    """
    own = [(file, seconds) for file in _named() if (seconds := _seconds_on(file, scene)) is not None]
    own.sort(key=lambda one: _time(one[0]), reverse=True)
    longest = max(own, key=lambda one: one[1], default=None)
    for one in own[count:]:
        if one is not longest:
            with suppress(OSError):
                one[0].unlink()


def _named() -> list[Path]:
    """The files with names of autosaves, without those of other users."""
    found = []
    for folder in _spare_folders():
        with suppress(OSError):
            found += [file for file in folder.iterdir() if AUTOSAVE.fullmatch(file.name) and _is_mine(file)]
    return found


def _is_mine(file: Path) -> bool:
    with suppress(OSError):
        return not hasattr(os, "getuid") or file.lstat().st_uid == os.getuid()
    return False


def _is_own(file: Path) -> bool:
    """Whether this program wrote a file with the name of an autosave: it is of the scene in its name."""
    named, texts = AUTOSAVE.fullmatch(file.name), own_texts(file)
    try:
        description = json.loads(texts["nerf"]) if texts else None
    except (TypeError, ValueError, RecursionError):
        return False
    scene = description.get("scene") if isinstance(description, dict) else None
    return named is not None and isinstance(scene, str) and scene.startswith(named[1])


def _entry(file: Path) -> Autosave | None:
    """What is known of an autosave; None if it has gone."""
    try:
        status = file.stat()
    except OSError:
        return None
    known: dict[str, Any] = {"file": file, "bytes": status.st_size, "saved": status.st_mtime}
    try:
        description = describe(file)
    except UserError as error:
        return Autosave(**known, problem=str(error))
    known |= {"scene": printable(description["scene_name"]), "method": printable(description["method"])}
    known |= {"step": description["step"], "seconds": description["seconds"]}
    if FIELD not in description:
        return Autosave(**known, problem="it does not say where its capture is: open that, then load this file")
    try:
        capture, load = _opening(description, file)
    except UserError as error:
        return Autosave(**known, problem=str(error))
    gone = capture is not None and not os.path.exists(capture)
    problem = f"{printable(capture)} is no longer there" if capture is not None and gone else ""
    return Autosave(**known, capture=capture, load=load, problem=problem)


def _opening(description: Mapping[str, Any], file: Path) -> tuple[Path | None, LoadOptions]:
    """The capture and the options to load it. Raises UserError if they are not as `left_off` has them."""
    fields = Fields({FIELD: description[FIELD]}, file)
    if not isinstance(description[FIELD], dict):
        raise fields.error(FIELD, "an object is needed: was this written by another version?")
    fields = Fields(description[FIELD], file, f"{FIELD}.")
    load = fields.values.get("load")
    if not isinstance(load, dict):
        raise fields.error("load", "an object is needed: was this written by another version?")
    capture = Path(fields.text("capture")) if "capture" in fields else None
    return capture, filled(LoadOptions, Fields(load, file, f"{FIELD}.load."))


def _time(file: Path) -> float:
    with suppress(OSError):
        return file.stat().st_mtime
    return 0.0


def _seconds_on(file: Path, scene: Scene) -> float | None:
    """The seconds for which an autosave was trained; None if it is not of the scene."""
    try:
        description = describe(file)
    except UserError:
        return None
    return description["seconds"] if scene.is_of(description) else None
