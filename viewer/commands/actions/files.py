"""Commands that open and write files."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

from nerf_core.common.language import marked
from nerf_core.live.messages import InOrder, OfRun, SaveCheckpoint, SaveUnsaved
from nerf_core.training.autosaves import checkpoint_name

from ...model.state import Action, AppState, SaveScreenshot, StartFilmExport
from ..registry import command, scene_is_open

SCREENSHOT = Path("screenshot.png")


@command("file.open", marked("Open…"), "File", 1, keys=("Ctrl+O",), menu="File")
def show_path_field(state: AppState) -> list[Action]:
    """Show the field for the path of a capture."""
    state.show_panels = state.focus_open = True
    state.raise_panel = "Scene"
    return []


@command("file.left_off", marked("Continue where you left off…"), "File", 1, menu="File")
def show_left_off(state: AppState) -> list[Action]:
    """Offer the autosaves, read anew."""
    state.left_off.read()
    state.show_left_off = True
    return []


@command("file.save", marked("Save checkpoint"), "File", 2, keys=("Ctrl+S",), menu="File", enabled=scene_is_open)
def save(state: AppState) -> list[Action]:
    """Save to the file in the form; without one, to a new file with the scene's name, which the form then shows."""
    if not state.checkpoint_file.strip() and state.snapshot.scene is not None:
        state.checkpoint_file = _free(checkpoint_name(state.snapshot.scene))
    return [SaveCheckpoint(Path(state.checkpoint_file.strip()))]


def saved_first(state: AppState, command: OfRun) -> Action:
    """Return what saves to a new file, and then, if that went well, obeys a command that forgets the model.

    The worker names the file when it writes it: if the answer is given twice, the second finds nothing to save.
    """
    try:
        folder = Path.cwd()
    except FileNotFoundError:  # it was deleted: to the autosaves then
        folder = None
    return InOrder((SaveUnsaved(folder=folder), command))


def _free(name: str) -> str:
    """The name, with a number if there is such a file in the current folder."""
    stem, suffix = os.path.splitext(name)
    numbered = (f"{stem}{f'-{n}' if n > 1 else ''}{suffix}" for n in itertools.count(1))
    return next(file for file in numbered if not os.path.lexists(file))


@command("file.export", marked("Export film"), "File", 3, keys=("Ctrl+E",), menu="File", enabled=scene_is_open)
def export(state: AppState) -> list[Action]:
    """Export what the form describes, and show its panel, which says how long it takes and can cancel it."""
    state.show_panels, state.raise_panel = True, "Export"
    return [StartFilmExport()]


@command("file.screenshot", marked("Save screenshot"), "File", 4, menu="File")
def screenshot(_: AppState) -> list[Action]:
    return [SaveScreenshot(SCREENSHOT)]
