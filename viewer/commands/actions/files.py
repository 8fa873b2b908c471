"""Commands that open and write files."""

from __future__ import annotations

import itertools
import os
import re
from pathlib import Path

from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import InOrder, OfRun, SaveCheckpoint
from nerf_core.training.checkpoint import SUFFIX

from ...model.state import Action, AppState, SaveScreenshot, StartFilmExport
from ..registry import command, scene_is_open

SCREENSHOT = Path("screenshot.png")


@command("file.open", "Open…", "File", 1, keys=("Ctrl+O",), menu="File")
def show_path_field(state: AppState) -> list[Action]:
    """Show the field for the path of a capture."""
    state.show_panels = state.focus_open = True
    state.raise_panel = "Scene"
    return []


@command("file.left_off", "Continue where you left off…", "File", 1, menu="File")
def show_left_off(state: AppState) -> list[Action]:
    """Offer the autosaves, read anew."""
    state.left_off.read()
    state.show_left_off = True
    return []


@command("file.save", "Save checkpoint", "File", 2, keys=("Ctrl+S",), menu="File", enabled=scene_is_open)
def save(state: AppState) -> list[Action]:
    """Save to the file in the form; without one, to a new file with the scene's name, which the form then shows."""
    if not state.checkpoint_file.strip() and state.snapshot.scene is not None:
        state.checkpoint_file = _new_file(state.snapshot.scene)
    return [SaveCheckpoint(Path(state.checkpoint_file.strip()))]


def saved_first(state: AppState, command: OfRun) -> Action:
    """Return what saves to a new file, and then, if that went well, obeys a command that forgets the model."""
    scene = state.snapshot.scene
    assert scene is not None  # without one there is nothing to forget
    return InOrder((SaveCheckpoint(Path(_new_file(scene))), command))


def _new_file(scene: Scene) -> str:
    """A checkpoint's name in the current folder that no file has, after the scene."""
    name = re.sub(r"[^\w.-]+", "-", scene.name).strip(".-")[:80] or "checkpoint"
    numbered = (f"{name}{f'-{n}' if n > 1 else ''}{SUFFIX}" for n in itertools.count(1))
    return next(file for file in numbered if not os.path.lexists(file))


@command("file.export", "Export film", "File", 3, keys=("Ctrl+E",), menu="File", enabled=scene_is_open)
def export(state: AppState) -> list[Action]:
    """Export what the form describes, and show its panel, which says how long it takes and can cancel it."""
    state.show_panels, state.raise_panel = True, "Export"
    return [StartFilmExport()]


@command("file.screenshot", "Save screenshot", "File", 4, menu="File")
def screenshot(_: AppState) -> list[Action]:
    return [SaveScreenshot(SCREENSHOT)]
