"""The saved layout of the docks, and what happens if its file is damaged."""

from __future__ import annotations

import itertools
import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import scripted
from imgui_bundle import imgui

from viewer.app.app import App
from viewer.ui.layout import HEADER, VIEWPORT, _checksum, _em_of, _has_place
from viewer.ui.layout_scale import fitted
from viewer.ui.theme import TEXT_PIXELS
from viewer.window import Window

Offscreen = Callable[..., Window]
SIZE = (1000, 700)


Open = Callable[..., App]


@pytest.fixture
def opened(offscreen: Offscreen) -> Iterator[Open]:
    """A function that opens apps, one at a time. Those that a failed test leaves open are closed.

    Their viewports stay empty, which spares most of the time, unless a picture is asked for.
    """
    apps: list[App] = []

    def open_app(file: Path | None, size: tuple[int, int] = SIZE, scale: float = 1.0, picture: bool = False) -> App:
        clock = itertools.count(100.0, 0.5)  # imgui waits 5 seconds after a change before it asks to be saved
        worker = scripted.ScriptedWorker(scripted.make_scene())
        worker.answering = picture
        app = App(offscreen(size, scale), worker, layout_file=file, time=lambda: next(clock))
        apps.append(app)
        app.settle(5)
        return app

    yield open_app
    for app in apps:
        app.close()


def viewport_of(app: App) -> tuple[float, ...]:
    return app.widgets["viewport"]


def move_the_divider(app: App) -> None:
    """Drag the divider between the viewport and the right column."""
    _, top, right, bottom = viewport_of(app)
    edge, middle = right + 2, (top + bottom) / 2
    app.injector.drag((edge, middle), (edge - 120, middle))
    app.settle(5)


def test_the_layout_survives_a_restart(opened: Open, tmp_path: Path) -> None:
    file = tmp_path / "deep" / "layout.ini"
    app = opened(file)
    before = viewport_of(app)
    move_the_divider(app)
    moved = viewport_of(app)
    assert moved[2] < before[2] - 100
    app.close()
    again = opened(file)
    assert viewport_of(again) == pytest.approx(moved, abs=2)
    assert not again.state.notices
    again.close()


@pytest.mark.parametrize("title", ["View", "Export"])
def test_the_tab_in_front_is_in_front_again(opened: Open, tmp_path: Path, title: str) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file)
    app.state.raise_panel = title
    app.settle(5)
    app.close()
    again = opened(file)
    again.settle(5)
    assert title in again._host.in_front


CHANGES = (1.0, 1.5), (1.0, 2.0), (1.0, 3.0), (1.5, 1.0), (2.0, 1.0), (3.0, 1.0), (2.0, 3.0), (3.0, 2.0)  # of the scale


def widths(app: App) -> dict[str, float]:
    """The widths in em of the panels, a panel of each dock, and of the picture."""
    found = {}
    for title in (VIEWPORT, "Ray", "Radiance", "Scene", "Training", "View"):
        window = imgui.internal.find_window_by_name(title)
        found[title] = window.size.x / app.theme.em
    return found


def grown(scale: float) -> tuple[int, int]:
    """A window of 70 × 45 em."""
    em = round(TEXT_PIXELS * scale)
    return 70 * em, 45 * em


@pytest.mark.parametrize(("saved", "shown"), CHANGES)
def test_a_layout_is_as_wide_in_em_at_every_scale(opened: Open, tmp_path: Path, saved: float, shown: float) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file, grown(saved), saved)
    move_the_divider(app)
    before = widths(app)
    app.close()
    again = opened(file, grown(shown), shown)
    assert widths(again) == pytest.approx(before, abs=0.3)
    assert not again.state.notices


@pytest.mark.parametrize(("saved", "shown"), CHANGES)
def test_panels_are_readable_if_the_window_does_not_grow_with_the_scale(
    opened: Open, tmp_path: Path, saved: float, shown: float
) -> None:
    """They are as wide as in the default layout, which gives them half of a window that is too small."""
    file, size = tmp_path / "layout.ini", (1600, 1000)
    default = widths(opened(None, size, shown))
    opened(file, size, saved).close()
    found = widths(opened(file, size, shown))
    narrower = {title: width for title, width in found.items() if width < default[title] - 0.5}
    assert not narrower, (default, found)


def test_the_docks_follow_a_window_to_a_screen_of_another_scale(
    opened: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file, grown(1.0))
    app.state.raise_panel = "Export"
    move_the_divider(app)
    before, front = widths(app), app._host.in_front
    for scale in (2.0, 1.5, 3.0, 1.0):
        monkeypatch.setattr(app.window, "scale", lambda scale=scale: scale)
        app.window.resize(*grown(scale))
        app.settle(8)
        assert widths(app) == pytest.approx(before, abs=0.4)
        assert app._host.in_front == front
        if scale == 3.0:
            app._layout.save()
            assert "\n; em: 45\n" in file.read_text("utf-8")


def test_a_layout_of_a_version_that_stored_no_size_of_text_is_fitted_too(opened: Open, tmp_path: Path) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file, grown(1.0))
    move_the_divider(app)
    before = widths(app)
    app.close()
    body = re.sub(r"; em: .*\n", "", file.read_text("utf-8").partition("\n")[2])
    assert "em:" not in body
    file.write_text(f"{HEADER}{_checksum(body)}\n{body}", "utf-8")
    assert widths(opened(file, grown(2.0), 2.0)) == pytest.approx(before, abs=0.3)


def test_a_text_of_any_kind_is_fitted(opened: Open, tmp_path: Path) -> None:
    """A file with the right checksum may still hold anything."""
    file = tmp_path / "layout.ini"
    opened(file).close()
    text, rng = file.read_text("utf-8"), random.Random(0)
    lines = text.splitlines()
    for _ in range(300):
        mutated = list(lines)
        for _ in range(rng.randrange(1, 6)):
            at, change = rng.randrange(len(mutated)), rng.randrange(4)
            if change == 0:
                mutated[at] = mutated[rng.randrange(len(mutated))]
            elif change == 1:
                mutated[at] = re.sub(r"\d+", lambda _: str(rng.choice((0, 1, 10**12))), mutated[at])
            elif change == 2:
                mutated[at] = mutated[at][: rng.randrange(len(mutated[at]) + 1)]
            else:
                mutated.insert(at, mutated.pop(rng.randrange(len(mutated))))
        body = "\n".join(mutated)
        fitted(body, _em_of(body) or 15.0, 30.0, (800, 600))
    assert fitted(text, 15.0, 30.0, (2000, 1400)) != text
    assert [_em_of(f"; em: {em}\n") for em in ("0", "0.01", "1e9", "900", "x", "15")] == [None] * 5 + [15.0]


def test_a_panel_that_floats_grows_with_the_text(opened: Open, tmp_path: Path) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file, grown(1.0))
    for _ in range(2):  # undocking gives it the size of its dock
        imgui.internal.dock_builder_dock_window("Training", 0)
        imgui.set_window_pos("Training", imgui.ImVec2(100, 80))
        imgui.set_window_size("Training", imgui.ImVec2(300, 120))
        app.settle(5)
    app.close()
    opened(file, grown(2.0), 2.0)
    window = imgui.internal.find_window_by_name("Training")
    assert (window.pos.x, window.pos.y, window.size.x, window.size.y) == (200, 160, 600, 240)


def test_a_window_that_closes_before_its_first_frame_keeps_the_layout(
    opened: Open, offscreen: Offscreen, tmp_path: Path
) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file)
    move_the_divider(app)
    moved = viewport_of(app)
    app.close()
    App(offscreen(SIZE), scripted.ScriptedWorker(scripted.make_scene()), layout_file=file).close()
    assert viewport_of(opened(file)) == pytest.approx(moved, abs=2)


def test_a_layout_that_lacks_a_panel_gives_way_to_the_default(opened: Open, tmp_path: Path) -> None:
    """A layout of an older version lacks new panels, which would float over the others."""
    file = tmp_path / "layout.ini"
    app = opened(file)
    default = viewport_of(app)
    move_the_divider(app)
    app.close()
    body = file.read_text("utf-8").partition("\n")[2].replace("[Window][Radiance]", "[Window][Something else]")
    file.write_text(f"{HEADER}{_checksum(body)}\n{body}", "utf-8")
    again = opened(file)
    assert viewport_of(again) == pytest.approx(default, abs=2)
    assert not again.state.notices


def test_a_panel_without_a_dock_does_not_float_over_the_others(opened: Open, tmp_path: Path) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file)
    default = viewport_of(app)
    move_the_divider(app)
    app.close()
    body = file.read_text("utf-8").partition("\n")[2]
    body = re.sub(r"(\[Window\]\[View\]\n)Pos=.*\n((?:.+\n)*?)DockId=.*\n", r"\1Pos=60,60\n\2", body)
    assert "[Window][View]\nPos=60,60\n" in body
    file.write_text(f"{HEADER}{_checksum(body)}\n{body}", "utf-8")
    assert viewport_of(opened(file)) == pytest.approx(default, abs=2)


def test_panels_that_were_hidden_when_the_window_closed_return_to_their_places(opened: Open, tmp_path: Path) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file)
    default = viewport_of(app)
    app.state.show_panels = False
    app.settle(5)
    app.close()
    again = opened(file)
    again.state.show_panels = True
    again.settle(5)
    assert viewport_of(again) == pytest.approx(default, abs=2)
    again.close()
    places = file.read_text("utf-8")
    assert all(_has_place(places, title) for title in ("View", "Export", "Notices", "Ray"))


@pytest.mark.parametrize("damage", ["cut", "binary", "foreign", "edited"])
def test_a_damaged_file_is_kept_aside_and_the_default_shown(opened: Open, tmp_path: Path, damage: str) -> None:
    file = tmp_path / "layout.ini"
    app = opened(file)
    default = viewport_of(app)
    move_the_divider(app)
    app.close()
    text = file.read_text("utf-8")
    broken = {
        "cut": text[: len(text) // 2].encode(),
        "binary": b"\xff\xfe\x00junk",
        "foreign": b"[Window][Debug]\nPos=1,1\n",
        "edited": text.replace("Size=", "Size=-", 1).encode(),
    }[damage]
    file.write_bytes(broken)
    again = opened(file)
    assert viewport_of(again) == pytest.approx(default, abs=2)
    assert (tmp_path / "layout.bad").read_bytes() == broken
    assert "damaged" in again.state.notices[0].notice.text
    again.close()
    assert file.read_text("utf-8").startswith(HEADER)


def test_a_layout_file_that_cannot_be_written_is_reported_once(opened: Open, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    app = opened(tmp_path / "file" / "layout.ini")
    for _ in range(2):
        move_the_divider(app)
        app.settle(10)
    notices = [shown.notice.text for shown in app.state.notices]
    assert len(notices) == 1
    assert "cannot be kept" in notices[0]


def test_without_a_file_nothing_is_written(opened: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    app = opened(None)
    move_the_divider(app)
    app.close()
    assert not list(tmp_path.iterdir())


def test_the_default_comes_back_on_demand(opened: Open) -> None:
    app = opened(None)
    default = viewport_of(app)
    move_the_divider(app)
    app._layout.reset()
    app.settle(5)
    assert viewport_of(app) == pytest.approx(default, abs=2)


def test_a_panel_that_floats_covers_what_is_under_it(opened: Open) -> None:
    """Docked panels paint no background, because only the cleared window lies behind them. Floating panels do."""
    app = opened(None, picture=True)
    left, top, right, bottom = (round(edge) for edge in viewport_of(app))
    x, y = (left + right) // 2, (top + bottom) // 2
    surface = [round(255 * channel) for channel in (app.theme.surface.x, app.theme.surface.y, app.theme.surface.z)]

    def float_the_panel() -> None:
        imgui.internal.dock_builder_dock_window("Training", 0)
        imgui.set_window_pos("Training", imgui.ImVec2(x - 150, y - 60))
        imgui.set_window_size("Training", imgui.ImVec2(300, 120))

    assert app.pixels()[y, x].tolist() != surface
    assert (app.pixels() == surface).all(-1).mean() > 0.2  # the panels in their docks
    float_the_panel()
    app.settle(5)
    float_the_panel()  # undocking gives it the size of its dock
    app.settle(5)
    covered = app.pixels()[y - 20 : y + 40, x - 100 : x + 100]
    ground, fields = surface, [round(255 * c) for c in (app.theme.raised.x, app.theme.raised.y, app.theme.raised.z)]
    assert np.logical_or((covered == ground).all(-1), (covered == fields).all(-1)).mean() > 0.5
