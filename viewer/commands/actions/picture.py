"""Commands for the render modes, one number key each."""

from __future__ import annotations

from functools import partial

from nerf_core.common.language import marked
from nerf_core.rendering.modes import COLOR, MODES, mode_names

from ...model.state import Action, AppState
from ..registry import command

TEXTS = marked("Show colour"), marked("Show view-dependence"), marked("view-dependence")  # of our own modes, as below
KEYS = 9  # number keys; further modes are only in the palette


def show(mode: str, state: AppState) -> list[Action]:
    state.mode = mode
    return []


for number, mode in enumerate(mode_names(), 1):
    label = COLOR if mode == COLOR else MODES.get(mode).label
    keys = (str(number),) if number <= KEYS else ()
    command(f"picture.{mode}", f"Show {label[:1].lower()}{label[1:]}", "Picture", number, keys=keys)(
        partial(show, mode)
    )
