"""Do a study's rows on the workers of a Ray cluster."""

from __future__ import annotations

from nerf_core.common.errors import UserError, shorten
from nerf_core.lab.job import RunRows


def rows_on(address: str) -> RunRows:
    """Return what does rows on a cluster. Raises UserError for an address that is none."""
    raise UserError(f"--workers {shorten(address)}: not yet")
