"""Drawing only what has changed leaves the same pixels as drawing everything."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import scripted
from imgui_bundle import imgui

from viewer.app.app import App
from viewer.draw.damage import NOTHING, VERTEX, Box, Drawn, Part, damage
from viewer.window import Window, open_offscreen, open_window

SIZE = (840, 620)


def quad(left: float, top: float, right: float, bottom: float, content: int = 0, clip: Box | None = None) -> Drawn:
    vertices = np.zeros(4, VERTEX)
    vertices["place"] = [(left, top), (right, top), (right, bottom), (left, bottom)]
    indices = np.array([0, 1, 2, 0, 2, 3], f"<u{imgui.INDEX_SIZE}")
    part = Part(clip or Box(0, 0, 100, 100), (1, content, False), 0, 6)
    return Drawn(vertices.tobytes(), indices.tobytes(), (part,))


def test_what_moved_is_drawn_where_it_was_and_where_it_is() -> None:
    still, before, now = quad(0, 0, 10, 10), quad(20, 20, 30, 30), quad(60.5, 60.5, 70.5, 70.5)
    assert damage([still, before], [still, now]) == [Box(20, 20, 30, 30), Box(60, 60, 71, 71)]
    assert damage([still, now], [still, now]) == []


def test_another_content_of_a_texture_is_a_change() -> None:
    assert damage([quad(5, 5, 9, 9)], [quad(5, 5, 9, 9, content=1)]) == [Box(5, 5, 9, 9)]


def test_rectangles_that_overlap_are_joined_until_none_does() -> None:
    apart = [quad(0, 0, 10, 10), quad(20, 0, 30, 10)]
    assert damage([], apart) == [Box(0, 0, 10, 10), Box(20, 0, 30, 10)]
    assert damage([], [*apart, quad(8, 2, 22, 4)]) == [Box(0, 0, 30, 10)]


def test_a_window_that_came_or_went_changes_its_place_alone() -> None:
    a, b = quad(0, 0, 10, 10), quad(50, 50, 60, 60)
    assert damage([a], [a, b]) == damage([a, b], [a]) == [Box(50, 50, 60, 60)]


def test_a_change_outside_the_clip_rectangle_is_none() -> None:
    inside = Box(0, 0, 10, 10)
    assert damage([quad(50, 50, 60, 60, clip=inside)], [quad(51, 50, 60, 60, clip=inside)]) == []
    assert damage([NOTHING], [NOTHING]) == []


def test_a_vertex_that_is_not_finite_changes_all_that_its_window_may_draw_to() -> None:
    clip = Box(10, 10, 40, 40)
    odd = quad(float("nan"), 0, 10, 10, clip=clip)
    assert damage([], [odd]) == [clip]


@pytest.fixture(params=["egl", "glfw"])
def window(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Window]:
    if request.param == "glfw":
        monkeypatch.setenv("DISPLAY", request.getfixturevalue("display"))
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        window = open_window("test", SIZE)
    else:
        window = open_offscreen(SIZE)
    yield window
    window.close()


def test_every_frame_is_as_if_it_were_drawn_whole(window: Window) -> None:
    assert window.keeps  # in both, with Mesa's software renderer
    worker = scripted.ScriptedWorker(scripted.make_scene())
    app = App(window, worker)
    drawn: list[float] = []
    try:
        rng = np.random.default_rng(0)
        shown: list[np.ndarray] = []
        window.swap = lambda: shown.append(window.read_pixels())  # before the frame goes to the screen
        surface = app.theme.surface
        for k in range(150):
            io = imgui.get_io()
            if k % 3 == 0:
                io.add_mouse_pos_event(*(float(v) for v in rng.uniform((0, 0), SIZE)))
            if k % 7 == 0:
                io.add_mouse_button_event(0, True)
            if k % 7 == 3:
                io.add_mouse_button_event(0, False)
            if k % 20 == 10:
                app.state.camera.orbit(5, 2, 500)
            if k == 60:
                app.state.show_panels = False
            if k == 80:
                app.state.show_panels = True
            worker.current = replace(worker.current, step=k)
            window.poll(0)
            app.frame(force=True)
            dirty = app._renderer.drawn
            drawn.append(sum((b.right - b.left) * (b.bottom - b.top) for b in dirty) / (SIZE[0] * SIZE[1]))
            app._renderer.render(imgui.get_draw_data(), window.framebuffer, (surface.x, surface.y, surface.z, 1.0))
            np.testing.assert_array_equal(shown[-1], window.read_pixels(), err_msg=f"frame {k}")
    finally:
        app.close()
    assert np.median(drawn) < 0.6  # and most frames draw only a part
