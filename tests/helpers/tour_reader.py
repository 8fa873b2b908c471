"""A reader of the tour, who does its tasks with mouse and keys."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from imgui_bundle import imgui

from viewer.app.app import App
from viewer.tour.steps import Task


def place(app: App, point: np.ndarray | None = None) -> tuple[float, float]:
    """Where a point of the scene lies in the window; without one, the middle of the viewport."""
    left, top, right, bottom = app.widgets["viewport"]
    if point is None:
        return (left + right) / 2, (top + bottom) / 2
    camera = app.state.camera.camera(*app.state.viewport)
    x, y, z = np.linalg.solve(camera.c2w[:, :3], point - camera.c2w[:, 3])
    return left + camera.cx - camera.fx * x / z, top + camera.cy + camera.fy * y / z


def press(app: App, name: str) -> None:
    """Click a widget in its middle."""
    left, top, right, bottom = app.widgets[name]
    app.injector.click((left + right) / 2, (top + bottom) / 2)


def do(app: App, task: Task, draw: Callable[[int], None]) -> None:
    """Do what a task asks for. draw: draws so many frames."""
    assert task.until is not None
    kind, *words = task.until.words.split()
    x, y = (0, 0) if app.state.page else place(app)
    match kind:
        case "moved":
            app.injector.drag((x - 20, y), (x + 40, y))
        case "photo":
            app.injector.key(imgui.Key.right_arrow)
        case "opened":
            app.injector.click(*(place(app, np.array([float(w) for w in words[1:4]])) if words else (x + 9, y + 9)))
        case "pointed":
            ray = app.state.snapshot.ray
            assert ray is not None
            app.injector.drag((x - 20, y), (x + 40, y))  # while the eye is on the ray, its samples hide each other
            draw(2)
            app.injector.move(*place(app, ray.origin + ray.last.t[ray.last.weights.argmax()] * ray.direction))
        case "hand":
            app.state.raise_panel = "Ray by hand"
            draw(3)
            press(app, "hand.add")
        case "training":
            app.injector.key(imgui.Key.space)
        case "mode":
            app.injector.key(imgui.Key._2)
        case "pins":
            app.injector._key(imgui.Key.mod_ctrl, True)
            for k in range(int(words[0])):
                app.injector.click(x + 20 * k, y)
            app.injector._key(imgui.Key.mod_ctrl, False)
        case "exported":
            export = app.state.snapshot.export
            if "export.start" in app.widgets and (export is None or export.state != "running"):
                press(app, "export.start")
        case _:
            raise AssertionError(f"no reader can do {task.until.words} here")
