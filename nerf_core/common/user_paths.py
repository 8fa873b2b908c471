"""Read paths as users write them."""

from __future__ import annotations

from pathlib import Path

from nerf_core.common.errors import UserError
from nerf_core.common.names import existing


def absolute(path: Path) -> Path:
    """Return the path with its folder. Raises UserError if it begins in the current folder, and that has gone."""
    try:
        return path.absolute()  # ".." stays: behind a link, it is another folder than the one before it
    except FileNotFoundError:
        raise UserError(f"{path}: the current folder was deleted: give a path that begins with /") from None


def own_path(path: Path) -> Path:
    """Return the absolute path that a user means: with `~` and `~name` as in a shell, or as `printable` shows it.

    Raises UserError for a user that this machine does not know, and as `absolute` does.
    """
    try:
        return absolute(existing(path.expanduser()))
    except RuntimeError:
        raise UserError(f"{path}: there is no such user's folder") from None
