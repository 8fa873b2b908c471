"""Every text on the screen is in the window's language, and fits."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import make_catalogue
import panel_states
import pytest
from imgui_bundle import ImVec2, imgui, implot
from panel_screen import Screen
from shown_texts import Brackets, Shown, outside, recorded

from nerf_core.common import language
from nerf_core.common.language import ENGLISH, languages, use_language
from viewer.app import bars
from viewer.commands.registry import MENUS
from viewer.model.state import Action, AppState
from viewer.ui.axes import number_ticks
from viewer.ui.contract import PANELS

WIDTHS = {"right": 23.0, "bottom": 39.0, "bottom_right": 23.0, "overlay": 50.0}  # em, in a window of 1280 × 800
HEIGHTS = {"right": 40.0, "bottom": 17.5, "bottom_right": 17.5, "overlay": 45.0}


@pytest.fixture(autouse=True)
def english() -> Iterator[None]:
    yield
    use_language(ENGLISH)


@cache
def marked() -> frozenset[str]:
    """The texts that the catalogues have, and those that are made up for the panels."""
    texts = [message.id for message in make_catalogue.extracted()]
    tree = ast.walk(ast.parse(Path(panel_states.__file__).read_text("utf-8")))
    made_up = {node.value for node in tree if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    autosave = {one.problem for one in panel_states._autosaves()}
    return frozenset({*(text if isinstance(text, str) else text[0] for text in texts), *made_up, *autosave})


@pytest.fixture
def brackets(monkeypatch: pytest.MonkeyPatch) -> Brackets:
    found = Brackets(marked())
    monkeypatch.setattr(language, "_catalogue", lambda _: found)
    use_language("ru")
    return found


@cache
def all_states() -> dict[str, AppState]:
    return panel_states.states()


def draw(screen: Screen, name: str, state: AppState, *, everything: bool = False) -> Shown:
    """Draw a panel until its columns have their widths, and record the last frame."""
    panel = PANELS.get(name)()
    scale = screen.em / 15
    screen.size = (WIDTHS[panel.dock] * screen.em, HEIGHTS[panel.dock] * screen.em)
    imgui.get_io().display_size = ImVec2(1280 * scale, 800 * scale)
    for _ in range(0 if everything else 3):
        screen.frame(panel, state)
    with recorded(everything=everything) as shown:
        screen.frame(panel, state)
    return shown


@pytest.mark.parametrize("name", PANELS.names())
def test_no_untranslated_text_reaches_the_screen(screen: Screen, name: str, brackets: Brackets) -> None:
    found = {
        (text, key)
        for key, state in all_states().items()
        for text in draw(screen, name, state, everything=True).texts
        if outside(text)
    }
    assert not found, dict(sorted(found))
    assert not brackets.unknown


@pytest.mark.parametrize("name", PANELS.names())
def test_every_number_on_the_screen_has_the_languages_separators(screen: Screen, name: str) -> None:
    use_language("ru")
    found = {
        (text, key)
        for key, state in all_states().items()
        for text in draw(screen, name, state, everything=True).english_numbers
    }
    assert not found, dict(sorted(found))


class Bars:
    """Menu and status bar, as a panel."""

    title, dock, order = "bars", "overlay", 0

    def draw(self, ui: Any, state: AppState) -> Iterator[Action]:
        yield from bars.draw_menu(ui, state)
        bars.draw_status(ui, state)


def test_no_untranslated_text_in_menus_and_bars(screen: Screen, brackets: Brackets) -> None:
    found: set[str] = set()
    for state in all_states().values():
        with recorded(everything=True) as shown:
            screen.frame(Bars(), state)  # pyright: ignore[reportArgumentType]
        found |= shown.texts
    assert {f"⟦{menu}⟧" for menu in MENUS} <= found
    assert not [text for text in found if outside(text)]
    assert not brackets.unknown


FITTED = (
    "training", "empty", "background", "first noise", "failed", "export running", "study done", "left off", "visits",
    "posing matching pairs of photos", "posing placing photos"
)  # fmt: skip  # states that differ in what they say


@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize("code", list(languages()))
@pytest.mark.parametrize("name", PANELS.names())
def test_no_text_is_cut_off(screen: Screen, name: str, code: str, scale: int) -> None:
    screen.theme.apply(scale)
    use_language(code)
    cut = {(key, *one) for key in FITTED for one in draw(screen, name, all_states()[key]).cut}
    assert not cut


@pytest.mark.parametrize(
    ("ends", "wanted"),
    [
        ((3.1, 4.4), "3,2 3,4 3,6 3,8 4 4,2 4,4"),
        ((-0.1, 0.3), "-0,1 0 0,1 0,2 0,3"),
        ((0.0, 4500.0), "0 1000 2000 3000 4000"),
    ],
)
def test_an_axis_has_round_numbers_as_the_language_writes_them(
    monkeypatch: pytest.MonkeyPatch, ends: tuple[float, float], wanted: str
) -> None:
    found: list[tuple[list[float], list[str]]] = []
    monkeypatch.setattr(implot, "setup_axis_ticks", lambda _, places, labels: found.append((places, labels)))
    number_ticks(0, *ends)
    assert not found  # implot writes English numbers
    use_language("ru")
    number_ticks(0, *ends)
    places, labels = found[0]
    assert labels == wanted.split()
    assert places == pytest.approx([float(label.replace(",", ".")) for label in labels])
