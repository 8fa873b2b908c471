"""Expand paths that begin with `~`."""

from __future__ import annotations

from pathlib import Path

from nerf_core.common.errors import UserError


def own_path(path: Path) -> Path:
    """Expand `~` and `~name` like a shell. Raises UserError for a user that this machine does not know."""
    try:
        return path.expanduser()
    except RuntimeError:
        raise UserError(f"{path}: there is no such user's folder") from None
