"""Whether torchrun started this process, and as which one of how many."""

from __future__ import annotations

import os


def started_together() -> bool:
    """Return whether torchrun started this process with others.

    RANK and WORLD_SIZE alone do not show it, because cluster managers set them too.
    """
    return "TORCHELASTIC_RUN_ID" in os.environ and os.environ.get("WORLD_SIZE", "1") != "1"


def is_first() -> bool:
    """Return whether this process is the only one or the first one: it prints and writes files."""
    return not started_together() or os.environ.get("RANK", "0") == "0"
