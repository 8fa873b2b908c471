"""The commands of the window. Each is defined once; keys, menus, help and palette read them from here.

A command is a function in a file of viewer/commands/actions/. Every file in that folder is found.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

from nerf_core.common.language import marked, phrase
from nerf_core.common.registry import Registry
from nerf_core.live.messages import Notice

from ..model.state import Action, AppState, ShownNotice

Section = Literal["Camera", "Ray", "Plots", "Picture", "Training", "File", "Show or hide", "Window", "Language", "Help"]
Menu = Literal["File", "View", "Help", "Language"]
SECTIONS: tuple[Section, ...] = get_args(Section)  # in the order of help and palette
MENUS: tuple[Menu, ...] = "File", "View", "Help"  # from left to right
SUBMENUS: dict[Menu, Menu] = {"Language": "View"}  # the menu at whose end each lies
TEXTS = (
    marked("Camera"), marked("Ray"), marked("Plots"), marked("Picture"), marked("Training"), marked("File"),
    marked("Show or hide"), marked("Window"), marked("Language"), marked("View"), marked("Help"),
)  # fmt: skip  # of sections and menus
Run = Callable[[AppState], list[Action]]


@dataclass(frozen=True)
class UserCommand:
    """A command for the user; not to be confused with the worker's `Command` messages.

    id: its name in the registry.
    title: its name in menus, help and palette.
    section: the heading under which help and palette list it.
    order: its position there.
    run: changes the state, and returns what the app or the worker should do.
    keys: chords such as "F", "Space", "→" or "Ctrl+S"; each of them runs the command.
    repeat: a held key runs it again and again.
    menu: the menu that lists it; there, a line separates the sections.
    enabled: whether it can run now.
    checked: whether the thing that it shows or hides is shown; None: the command is not a switch.
    chosen: whether it is the one of its menu that holds now; None: the command is not one of a choice.
    """

    id: str
    title: str
    section: Section
    order: int
    run: Run
    keys: tuple[str, ...]
    repeat: bool
    menu: Menu | None
    enabled: Callable[[AppState], bool]
    checked: Callable[[AppState], bool] | None
    chosen: Callable[[AppState], bool] | None


USER_COMMANDS: Registry[UserCommand] = Registry("command", f"{__name__.rpartition('.')[0]}.actions")


def scene_is_open(state: AppState) -> bool:
    return state.snapshot.scene is not None


def always(_: AppState) -> bool:
    return True


def command(
    id: str,
    title: str,
    section: Section,
    order: int,
    *,
    keys: tuple[str, ...] = (),
    repeat: bool = False,
    menu: Menu | None = None,
    enabled: Callable[[AppState], bool] = always,
    checked: Callable[[AppState], bool] | None = None,
    chosen: Callable[[AppState], bool] | None = None,
) -> Callable[[Run], Run]:
    """Decorator that registers a function as a command. For the arguments see `UserCommand`."""

    def keep(run: Run) -> Run:
        found = UserCommand(id, title, section, order, run, keys, repeat, menu, enabled, checked, chosen)
        USER_COMMANDS.register(id)(found)
        return run

    return keep


def commands() -> list[UserCommand]:
    """Return all commands, sorted by section and order."""
    found = [USER_COMMANDS.get(name) for name in USER_COMMANDS.names()]
    return sorted(found, key=lambda c: (SECTIONS.index(c.section), c.order, c.id))


def run(id: str, state: AppState) -> list[Action]:
    """Run a command by its id. A disabled command does nothing."""
    found = USER_COMMANDS.get(id)
    return found.run(state) if found.enabled(state) else []


def invoke(found: UserCommand, state: AppState) -> list[Action]:
    """Run a command for the user. If it fails, a notice says so, and the window goes on."""
    try:
        return found.run(state)
    except Exception as error:
        words = phrase(
            "the command {title} failed ({error}); the rest goes on",
            title=phrase(found.title), error=f"{type(error).__name__}: {error}",
        )  # fmt: skip
        notice = Notice("error", words, detail=traceback.format_exc())
        state.notices.append(ShownNotice(notice, state.time))
        return []


def with_keys(text: str, id: str) -> str:
    """Return a tooltip with the keys of a command at its end: "see the whole scene (F)".

    text: in the window's language.
    """
    keys = ", ".join(USER_COMMANDS.get(id).keys)
    return f"{text} ({keys})" if keys else text
