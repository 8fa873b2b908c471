"""Commands for the opened ray."""

from __future__ import annotations

from nerf_core.common.language import marked
from nerf_core.live.messages import StopInspecting

from ...model.state import Action, AppState
from ..registry import command


@command("ray.close", marked("Close the ray"), "Ray", 1, keys=("Esc",), enabled=lambda state: state.inspect is not None)
def close(_: AppState) -> list[Action]:
    return [StopInspecting()]
