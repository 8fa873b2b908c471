"""Drawing only what has changed leaves the same pixels as drawing everything."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
import scripted
from imgui_bundle import imgui

from viewer.app.app import App
from viewer.draw import damage as damaged
from viewer.draw.damage import DEAR, INDEX, NOTHING, VERTEX, Box, Drawn, Part, damage
from viewer.window import Window, open_offscreen, open_window

SIZE = (840, 620)


Corners = tuple[float, float, float, float]


def window_of(*commands: tuple[Sequence[Corners], int, Box]) -> Drawn:
    """A window whose commands draw rectangles: their corners, the content of the texture, and the clip rectangle."""
    vertices = np.zeros(sum(4 * len(rectangles) for rectangles, _, _ in commands), VERTEX)
    indices, parts, first = list[int](), list[Part](), 0
    for rectangles, content, clip in commands:
        parts.append(Part(clip, (1, content, False), len(indices), 6 * len(rectangles)))
        for left, top, right, bottom in rectangles:
            vertices["place"][first : first + 4] = [(left, top), (right, top), (right, bottom), (left, bottom)]
            indices += [first + k for k in (0, 1, 2, 0, 2, 3)]
            first += 4
    return Drawn(vertices.tobytes(), np.array(indices, INDEX).tobytes(), tuple(parts))


def quad(left: float, top: float, right: float, bottom: float, content: int = 0, clip: Box | None = None) -> Drawn:
    return window_of(([(left, top, right, bottom)], content, clip or Box(0, 0, 1000, 1000)))


def test_what_moved_is_drawn_where_it_was_and_where_it_is() -> None:
    still, before, now = quad(0, 0, 10, 10), quad(200, 200, 300, 300), quad(600.5, 600.5, 700.5, 700.5)
    assert damage([still, before], [still, now]) == [Box(200, 200, 300, 300), Box(600, 600, 701, 701)]
    assert damage([still, now], [still, now]) == []


def test_another_content_of_a_texture_is_a_change() -> None:
    assert damage([quad(5, 5, 9, 9)], [quad(5, 5, 9, 9, content=1)]) == [Box(5, 5, 9, 9)]


def test_rectangles_that_overlap_are_joined_until_none_does() -> None:
    apart = [quad(0, 0, 100, 100), quad(200, 0, 300, 100)]
    assert damage([], apart) == [Box(0, 0, 100, 100), Box(200, 0, 300, 100)]
    assert damage([], [*apart, quad(80, 20, 220, 40)]) == [Box(0, 0, 300, 100)]


def test_rectangles_are_joined_if_that_is_few_more_pixels_than_dear_is_one_more() -> None:
    side = int((DEAR / 2) ** 0.5)
    near, far = quad(side, side, 2 * side, 2 * side), quad(2 * side, 2 * side, 3 * side, 3 * side)
    assert damage([], [quad(0, 0, side, side), near]) == [Box(0, 0, 2 * side, 2 * side)]
    assert damage([], [quad(0, 0, side, side), far]) == [Box(0, 0, side, side), Box(*(2 * [2 * side] + 2 * [3 * side]))]


def test_a_window_that_came_or_went_changes_its_place_alone() -> None:
    a, b = quad(0, 0, 10, 10), quad(500, 500, 600, 600)
    assert damage([a], [a, b]) == damage([a, b], [a]) == [Box(500, 500, 600, 600)]


def test_a_change_outside_the_clip_rectangle_is_none() -> None:
    inside = Box(0, 0, 10, 10)
    assert damage([quad(50, 50, 60, 60, clip=inside)], [quad(51, 50, 60, 60, clip=inside)]) == []
    assert damage([NOTHING], [NOTHING]) == []


def test_a_vertex_that_is_not_finite_changes_all_that_its_command_may_draw_to() -> None:
    clip = Box(10, 10, 40, 40)
    for odd in ("nan", "inf"):
        assert damage([], [quad(float(odd), 0, 10, 10, clip=clip)]) == [clip]


SCREEN = Box(0, 0, 1000, 1000)
FAR = [(100.0 * k, 0.0, 100.0 * k + 10, 10.0) for k in range(8)]


def test_of_a_command_the_triangles_alone_that_changed_are_drawn() -> None:
    moved = [*FAR[:3], (900.0, 700.0, 910.0, 710.0), *FAR[4:]]
    assert damage([window_of((FAR, 0, SCREEN))], [window_of((moved, 0, SCREEN))]) == [
        Box(300, 0, 310, 10), Box(900, 700, 910, 710)
    ]  # fmt: skip
    digit = [*FAR[:3], (320.0, 0.0, 330.0, 10.0), *FAR[3:]]  # one more: all later vertices have other numbers
    one, more = window_of((FAR, 0, SCREEN)), window_of((digit, 0, SCREEN))
    assert damage([one], [more]) == damage([more], [one]) == [Box(320, 0, 330, 10)]


def test_of_a_window_the_commands_alone_that_came_are_drawn() -> None:
    first, last, between = (FAR[:2], 0, SCREEN), (FAR[6:], 0, SCREEN), (FAR[4:5], 1, SCREEN)
    assert damage([window_of(first, last)], [window_of(first, between, last)]) == [Box(400, 0, 410, 10)]


def test_a_command_that_comes_again_is_drawn_once_more() -> None:
    first, twice, last = (FAR[:1], 0, SCREEN), (FAR[3:4], 1, SCREEN), (FAR[6:7], 2, SCREEN)
    one, more = window_of(first, twice, last), window_of(first, twice, twice, last)
    assert damage([one], [more]) == damage([more], [one]) == [Box(300, 0, 310, 10)]  # it may be translucent


def test_the_same_triangles_under_another_clip_rectangle_are_drawn_in_both() -> None:
    small, large = Box(0, 0, 5, 10), Box(5, 0, 710, 10)
    assert damage([window_of((FAR, 0, small))], [window_of((FAR, 0, large))]) == [Box(0, 0, 710, 10)]


def test_where_three_rectangles_are_joined_none_is_left_that_overlaps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(damaged, "DEAR", 0)
    assert damage([], [quad(0, 0, 10, 10), quad(20, 5, 30, 40), quad(5, 30, 22, 35)]) == [Box(0, 0, 30, 40)]


Soup = tuple[list[tuple[float, float]], list[tuple[int, int, int]], tuple[float, float]]


@pytest.mark.parametrize("seed", range(150))
def test_outside_of_what_changed_triangles_that_share_vertices_are_the_same(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(damaged, "DEAR", 0)
    rng = np.random.default_rng(seed)

    def triangle() -> tuple[int, int, int]:
        a, b, c = rng.integers(0, 8, 3).tolist()
        return a, b, c

    def place() -> tuple[float, float]:
        x, y = rng.integers(0, 64, 2).tolist()
        return float(x), float(y)

    places, triangles, origin = (
        [place() for _ in range(8)],
        [(0, 1, 2), (5, 6, 7), *(triangle() for _ in range(3))],
        (0.0, 0.0),
    )
    before: Soup = list(places), list(triangles), origin
    for _ in range(rng.integers(1, 3)):
        k = int(rng.integers(len(triangles)))
        match rng.integers(6):
            case 0:
                places[rng.integers(8)] = place()
            case 1:
                triangles.insert(k, triangle())
            case 2:
                triangles.insert(k, triangles[k])
            case 3:
                triangles[k] = triangle()
            case 4:
                triangles.pop(k) if len(triangles) > 3 else None
            case _:
                origin = float(rng.integers(3)), 1.0
    now: Soup = places, triangles, origin
    told = np.zeros((64, 64), int)
    for box in damage([_drawn(*before)], [_drawn(*now)]):
        told[box.top : box.bottom, box.left : box.right] += 1
    assert told.max() <= 1
    old, new = _triangles(*before), _triangles(*now)
    for y, x in np.argwhere(told == 0).tolist():
        assert [t for t, box in old if _inside(box, x, y)] == [t for t, box in new if _inside(box, x, y)]


def _drawn(
    places: list[tuple[float, float]], triangles: list[tuple[int, int, int]], origin: tuple[float, float]
) -> Drawn:
    vertices = np.zeros(len(places), VERTEX)
    vertices["place"] = places
    indices = np.array(triangles, INDEX).ravel()
    part = Part(Box(0, 0, 64, 64), (1, 0, False), 0, len(indices))
    return Drawn(vertices.tobytes(), indices.tobytes(), (part,), origin)


def _triangles(
    places: list[tuple[float, float]], triangles: list[tuple[int, int, int]], origin: tuple[float, float]
) -> list[tuple[bytes, Box]]:
    """The triangles as they are on the screen, and a rectangle around each."""
    corners = [np.array([places[k] for k in one]) - origin for one in triangles]
    return [(one.tobytes(), Box(*one.min(0).astype(int).tolist(), *one.max(0).astype(int).tolist())) for one in corners]


def _inside(box: Box, x: int, y: int) -> bool:
    return box.left <= x < box.right and box.top <= y < box.bottom


@pytest.mark.parametrize("seed", range(100))
def test_outside_of_what_changed_two_frames_have_the_same_pixels(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(damaged, "DEAR", 0)
    rng = np.random.default_rng(seed)

    def rectangles() -> list[Corners]:
        found = list[Corners]()
        for _ in range(rng.integers(1, 5)):
            x, y, wide, high = rng.integers((0, 0, 1, 1), (56, 56, 9, 9)).tolist()
            found.append((x, y, x + wide, y + high))
        return found

    def command() -> tuple[list[Corners], int, Box]:
        x, y = rng.integers(0, 32, 2).tolist()
        return rectangles(), int(rng.integers(2)), Box(x, y, x + 32, y + 32)

    before = [[command() for _ in range(rng.integers(1, 4))] for _ in range(4)]
    now = [[(list(some), content, clip) for some, content, clip in window] for window in before]
    for _ in range(rng.integers(1, 4)):
        window = now[rng.integers(len(now))]
        some = window[rng.integers(len(window))][0]
        match rng.integers(6):
            case 0:
                some[rng.integers(len(some))] = rectangles()[0]
            case 1:
                some.insert(int(rng.integers(len(some))), rectangles()[0])
            case 2:
                some.pop() if len(some) > 1 else None
            case 3:
                window.insert(int(rng.integers(len(window))), command())
            case 4:
                window.reverse()
            case _:
                now.reverse()
    found = damage([window_of(*one) for one in before], [window_of(*one) for one in now])
    told = np.zeros((64, 64), int)
    for box in found:
        told[box.top : box.bottom, box.left : box.right] += 1
    assert told.max() <= 1
    assert not (_painted(before) != _painted(now)).any(-1)[told == 0].any()


def _painted(windows: Sequence[Sequence[tuple[list[Corners], int, Box]]]) -> np.ndarray:
    """Pixels (64, 64, 2) that tell which rectangles were painted over each other there, and in which order."""
    pixels = np.zeros((64, 64, 2), np.int64)
    for window in windows:
        for rectangles, content, clip in window:
            for left, top, right, bottom in rectangles:
                box = clip.common(Box(int(left), int(top), int(right), int(bottom)))
                inside = pixels[box.top : max(box.bottom, box.top), box.left : max(box.right, box.left)]
                value = hash((left, top, right, bottom, content)) % 1000003
                inside[...] = (inside * (31, 17) + value) % 1000003
    return pixels


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
    worker = scripted.ScriptedWorker(scripted.make_scene())
    app = App(window, worker)
    drawn: list[float] = []
    try:
        rng = np.random.default_rng(0)
        shown: list[np.ndarray] = []
        swap = window.swap

        def show() -> None:
            shown.append(window.read_pixels())  # before the frame goes to the screen
            swap()

        window.swap = show
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
            if k in (100, 101, 120):  # to another size and back between two frames
                for size in ((SIZE[0] - 50, SIZE[1] - 40), SIZE):
                    window.resize(*size)
                    while window.size() != size:
                        window.poll(0.01)
                assert not window.keeps
            worker.current = replace(worker.current, step=k)
            window.poll(0)
            app.frame(force=True)
            dirty = app._renderer.drawn
            drawn.append(sum(box.area for box in dirty) / (SIZE[0] * SIZE[1]))
            app._renderer.render(imgui.get_draw_data(), window.framebuffer, (surface.x, surface.y, surface.z, 1.0))
            np.testing.assert_array_equal(shown[-1], window.read_pixels(), err_msg=f"frame {k}")
        assert window.keeps  # in both, with Mesa's software renderer
    finally:
        app.close()
    assert np.median(drawn) < 0.6  # and most frames draw only a part
