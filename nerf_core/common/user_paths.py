"""Read paths as users write them."""

from __future__ import annotations

from pathlib import Path

from nerf_core.common.errors import UserError
from nerf_core.common.names import existing


def own_path(path: Path) -> Path:
    """Return the path that a user means: with `~` and `~name` expanded like a shell, or as `printable` shows it.

    Raises UserError for a user that this machine does not know.
    """
    try:
        return existing(path.expanduser())
    except RuntimeError:
        raise UserError(f"{path}: there is no such user's folder") from None
