"""Checkpoints: one safetensors file with a JSON description inside.

A file is written completely or not at all, and nothing in it can be executed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.files import utf8_path, write_atomically

if TYPE_CHECKING:
    from torch import Tensor

VERSION = 1
SUFFIX = ".safetensors"
METADATA = {"nerf", "version", "sha256"}  # the texts that each file's header holds
MOST_HEADER_BYTES = 100_000_000  # the limit of safetensors
# The fields of the description with their types and, for numbers, the largest value; the smallest is 0.
REQUIRED: dict[str, tuple[type, float]] = {
    "method": (str, 0), "config": (dict, 0), "steps": (int, 2**53), "seed": (int, 2**63 - 1), "threads": (int, 1024),
    "step": (int, 2**53), "seconds": (float, 1e12), "scene": (str, 0), "scene_name": (str, 0),
    "scene_summary": (str, 0),
}  # fmt: skip


class Damaged(UserError):
    """A file cannot be a checkpoint as it was written: it was cut short or changed."""


def save(path: Path, description: Mapping[str, Any], tensors: Mapping[str, Tensor], *, numbered: bool = False) -> Path:
    """Write a checkpoint, atomically.

    Args:
        path: the file.
        description: JSON values, those of `Trainer.describe()`.
        tensors: by name, those of `Trainer.state()`.
        numbered: see `write_atomically`.

    Returns:
        The file that was written.

    Raises:
        UserError: the file cannot be written; an old file of this name stays as it was.
    """
    from safetensors.torch import save as serialise

    arrays = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps(description, sort_keys=True)
    metadata = {"nerf": text, "version": str(VERSION), "sha256": _digest(str(VERSION), text, arrays)}
    return write_atomically(path, serialise(arrays, metadata=metadata), numbered=numbered)


def load(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read a checkpoint.

    Args:
        path: the file.

    Returns:
        The description and the tensors that `save` wrote.

    Raises:
        Damaged: the file was cut short or changed.
        UserError: the file is missing, is no checkpoint, or was written by a newer version.
    """
    metadata, arrays = _read(path, tensors=True)
    if metadata["sha256"] != _digest(metadata["version"], metadata["nerf"], arrays):
        raise Damaged(f"{path}: damaged: its checksum does not match; use an earlier checkpoint")
    return _described(path, metadata["nerf"]), arrays


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Put the checkpoint's path before what is wrong with its contents."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def describe(path: Path) -> dict[str, Any]:
    """Read the description alone, which is fast. Raises UserError as `load` does, except for damaged tensors."""
    return _described(path, _read(path, tensors=False)[0]["nerf"])


def tensor(path: Path, name: str) -> np.ndarray | None:
    """Read one tensor alone, which is fast and needs no torch. Its checksum is not compared.

    None: there is none, it is damaged, or numpy has no such type.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with utf8_path(path) as readable, safe_open(readable, framework="numpy") as file:
            return file.get_tensor(name) if name in file.keys() else None  # noqa: SIM118  no dict
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError):  # the last two: no such type in numpy
        return None


def _read(path: Path, *, tensors: bool) -> tuple[dict[str, str], dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise UserError(f"{path}: no such checkpoint; give a {SUFFIX} file that `nerf-core train` or Save wrote")
    try:
        framework = "pt" if tensors else "numpy"  # which loads no torch
        with utf8_path(path) as readable, safe_open(readable, framework=framework) as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()} if tensors else {}  # noqa: SIM118  no dict
    except (SafetensorError, OSError, ValueError):
        raise Damaged(
            f"{path}: not a readable checkpoint: cut short, damaged or no {SUFFIX} file; use an earlier one"
        ) from None
    if not set(metadata) >= METADATA:
        raise UserError(f"{path}: a safetensors file, but not a checkpoint of nerf-viewer")
    if metadata["version"] not in {str(v) for v in range(1, VERSION + 1)}:
        raise UserError(
            f"{path}: checkpoint version {shorten(metadata['version'])}, this program reads up to {VERSION}: update it"
        )
    return metadata, arrays


def _described(path: Path, text: str) -> dict[str, Any]:
    try:
        description = json.loads(text)
    except (ValueError, RecursionError):
        description = None
    if not isinstance(description, dict):
        raise UserError(f"{path}: its description is no JSON object: not a checkpoint of nerf-viewer")
    for name, (kind, most) in REQUIRED.items():
        value = description.get(name)
        if type(value) is not kind or (isinstance(value, (int, float)) and not 0 <= value <= most):
            raise UserError(
                f"{path}: field {name} is missing, no {kind.__name__} or out of range: made by another version"
            )
    return description


def _digest(version: str, text: str, arrays: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of version, JSON and every tensor's name, type, shape and bytes.

    It is needed because safetensors itself has no checksum.
    """
    import torch

    digest = hashlib.sha256(f"{version} {text}".encode())
    for name in sorted(arrays):
        value = arrays[name]
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        if value.numel():  # an empty tensor cannot be viewed as bytes
            digest.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def newest(folder: Path) -> tuple[Path, dict[str, Any], dict[str, Tensor], tuple[str, ...]]:
    """Read the newest intact checkpoint of a run folder.

    Args:
        folder: the run folder.

    Returns:
        Its path, description and tensors, and the errors of newer checkpoints that are damaged.

    Raises:
        UserError: the folder has no checkpoint that can be read, or a newer one is not damaged and cannot be read
            either. To continue from an older one would then fork the run and take the newer one's name.
    """
    rejected: list[str] = []
    for path in reversed(checkpoints(folder)):
        try:
            description, tensors = load(path)
        except Damaged as error:
            rejected.append(str(error))
            continue
        except UserError as error:
            raise UserError(f"{error}; or move it away, to use an earlier checkpoint") from None
        if description["step"] != step_of(path):
            raise UserError(f"{path}: holds step {description['step']:,}: give the file its own name, or move it away")
        return path, description, tensors, tuple(rejected)
    advice = f"train first: nerf-core train DATA --out {folder}"
    reason = rejected[0] if rejected else f"no checkpoints/step_*{SUFFIX} in it: {advice}"
    raise UserError(f"{folder}: not a run that can be continued: {reason}")


def step_path(folder: Path, step: int) -> Path:
    """Return the file of the checkpoint of a step in a run folder."""
    return folder / "checkpoints" / f"step_{step:08d}{SUFFIX}"


def step_of(path: Path) -> int:
    """Return the step in the name of a checkpoint; −1 if the name is not one of `step_path`."""
    digits = path.stem.removeprefix("step_")
    step = int(digits) if digits.isdecimal() and len(digits) < 20 else -1
    return step if path.name == step_path(path, step).name else -1


def checkpoints(folder: Path) -> list[Path]:
    """Return the files of a run folder that are named as its checkpoints, oldest first.

    Other files in their folder are the user's own. They are never read, renamed or deleted.
    """
    named = [path for path in folder.glob(f"checkpoints/step_*{SUFFIX}") if step_of(path) >= 0]
    return sorted(named, key=step_of)


def keep_newest(folder: Path, count: int = 2) -> None:
    """Delete all but the newest `count` checkpoints of a run folder.

    Two are kept by default: if the newest is damaged, its predecessor is used. A file that is not a checkpoint of the
    step in its name was not written here: it stays, and is not counted.
    """
    for path in [path for path in checkpoints(folder) if is_own(path)][:-count]:
        path.unlink(missing_ok=True)


def has_own_header(path: Path) -> bool:
    """Return whether a file begins as the checkpoints of this program do, even if the rest is cut short or changed."""
    return own_texts(path) is not None


def own_texts(path: Path) -> dict[str, Any] | None:
    """Read the texts of METADATA from a file's beginning, even if the rest is cut short or changed.

    Returns:
        The texts by name; None if the file does not begin as the checkpoints of this program do.
    """
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length)) if length <= MOST_HEADER_BYTES else None
    except (OSError, ValueError, RecursionError):
        return None
    metadata = header.get("__metadata__") if isinstance(header, dict) else None
    return metadata if isinstance(metadata, dict) and set(metadata) >= METADATA else None


def is_own(path: Path) -> bool:
    """Return whether a file is a checkpoint of the step in its name, as far as its header shows."""
    try:
        return describe(path)["step"] == step_of(path)
    except UserError:
        return False
