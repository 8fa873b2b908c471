"""Paths as people write them."""

from __future__ import annotations

from pathlib import Path

from nerf_core.common.errors import UserError


def own_path(path: Path) -> Path:
    """`~` and `~name` as a shell has them. Raises UserError for somebody who is not known here."""
    try:
        return path.expanduser()
    except RuntimeError:
        raise UserError(f"{path}: there is no such user's folder") from None
