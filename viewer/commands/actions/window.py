"""Commands for what the window shows, and for the window itself."""

from __future__ import annotations

from nerf_core.common.language import marked

from ...model.state import Action, AppState
from ..registry import command


@command("show.cameras", marked("Cameras"), "Show or hide", 1, menu="View", checked=lambda s: s.show_cameras)
def cameras(state: AppState) -> list[Action]:
    state.show_cameras = not state.show_cameras
    return []


@command("show.ray", marked("Opened rays"), "Show or hide", 2, menu="View", checked=lambda s: s.show_samples)
def ray(state: AppState) -> list[Action]:
    state.show_samples = not state.show_samples
    return []


@command(
    "show.panels", marked("Panels"), "Show or hide", 3, keys=("Tab",), menu="View", checked=lambda s: s.show_panels
)
def panels(state: AppState) -> list[Action]:
    state.show_panels = not state.show_panels
    return []


@command("show.help", marked("Mouse and keys"), "Help", 9, keys=("H",), menu="Help", checked=lambda s: s.show_help)
def help_(state: AppState) -> list[Action]:
    state.show_help = not state.show_help
    return []


@command("show.palette", marked("Command palette"), "Window", 1, keys=("Ctrl+P",), menu="View")
def palette(state: AppState) -> list[Action]:
    state.show_palette = True
    return []


@command("window.layout", marked("Reset the layout"), "Window", 2, menu="View")
def reset_layout(state: AppState) -> list[Action]:
    state.reset_layout = True
    return []


@command("window.quit", marked("Quit"), "Window", 3, menu="File")
def quit_(state: AppState) -> list[Action]:
    state.quit = True
    return []
