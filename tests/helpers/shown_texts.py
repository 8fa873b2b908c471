"""Record the texts that are given to imgui and implot, and what of them does not fit."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest
from imgui_bundle import imgui, implot

from viewer.ui.theme import TEXT_PIXELS

# Which arguments are shown, by the function. A name with a number format also has texts in that.
TEXTS: dict[str, tuple[int | str, ...]] = {
    "text": (0,), "text_unformatted": (0,), "text_wrapped": (0,), "text_colored": (1,), "text_disabled": (0,),
    "bullet_text": (0,), "label_text": (0, 1), "separator_text": (0,), "button": (0,), "small_button": (0,),
    "checkbox": (0,), "radio_button": (0,), "selectable": (0,), "menu_item": (0,), "begin_menu": (0,), "begin": (0,),
    "combo": (0, 2), "begin_combo": (0, 1), "input_text": (0,), "input_text_with_hint": (0, 1), "color_edit3": (0,),
    "slider_float": (0, 4), "slider_int": (0, 4), "drag_float": (0, 5), "drag_int": (0, 5), "tree_node": (0,),
    "tree_node_ex": (0,), "collapsing_header": (0,), "begin_tab_item": (0,), "table_setup_column": (0,),
    "progress_bar": (2, "overlay"), "set_tooltip": (0,), "set_item_tooltip": (0,),
}  # fmt: skip
PLOT_TEXTS: dict[str, tuple[int | str, ...]] = {"setup_axis": (1,), "setup_axis_ticks": (2,), "annotation": (4,)}
NO_ITEM = {
    "begin",
    "begin_menu",
    "menu_item",
    "table_setup_column",
    "set_tooltip",
    "set_item_tooltip",
    "begin_tab_item",
}
FORMAT = re.compile(r"%[-+ #0]*\d*(?:\.\d+)?[dfgeus%]")
SLACK = 1.5  # pixels: rounding


class Cut(NamedTuple):
    """A text that does not fit. pixels: how much of it is hidden at the right."""

    text: str
    pixels: float


class Shown:
    """texts: what was shown. cut: what of it did not fit; forget it after the first frames, in which columns settle."""

    def __init__(self) -> None:
        self.texts: set[str] = set()
        self.cut: set[Cut] = set()
        self._columns: list[str] = []  # of the table being set up: they are shown if it has a row of headers

    def note(self, name: str, texts: list[str]) -> None:
        if name == "table_setup_column":
            self._columns += texts
        else:
            self.texts.update(texts)

    def headers(self) -> None:
        self.texts.update(self._columns)

    def table(self) -> None:
        self._columns = []

    def measure(self, text: str) -> None:
        """Note a text whose item reaches beyond what is visible of its window, unless that can be scrolled to."""
        clip = imgui.get_window_draw_list().get_clip_rect_max().x
        window = imgui.internal.get_current_window()
        beyond = imgui.get_item_rect_max().x - clip
        if window.scroll_max.x <= 0 and beyond > SLACK * imgui.get_font_size() / TEXT_PIXELS:
            self.cut.add(Cut(text, round(beyond, 1)))


@contextmanager
def recorded(*, hovered: bool = False) -> Iterator[Shown]:
    """Record what is shown. hovered: everything is, so that all tooltips are recorded; none is drawn."""
    shown = Shown()
    with pytest.MonkeyPatch.context() as patch:
        for module, names in ((imgui, TEXTS), (implot, PLOT_TEXTS)):
            for name, places in names.items():
                patch.setattr(module, name, _recording(shown, name, getattr(module, name), places))
        patch.setattr(imgui.ImDrawList, "add_text", _drawing(shown, imgui.ImDrawList.add_text))
        for name, noted in (("table_headers_row", shown.headers), ("begin_table", shown.table)):
            patch.setattr(imgui, name, _before(noted, getattr(imgui, name)))
        if hovered:
            patch.setattr(imgui, "is_item_hovered", lambda *_: True)
            patch.setattr(implot, "is_plot_hovered", lambda *_: True)
        yield shown


def _recording(shown: Shown, name: str, real: Callable[..., Any], places: tuple[int | str, ...]) -> Callable[..., Any]:
    def call(*args: Any, **options: Any) -> Any:
        found: list[str] = []
        for place in places:
            value = options.get(place) if isinstance(place, str) else args[place] if place < len(args) else None
            found += [value] if isinstance(value, str) else value if isinstance(value, list) else []
        texts = [label for text in found if (label := _label(text))]
        shown.note(name, texts)
        if name == "set_tooltip":
            return None
        result = real(*args, **options)
        if texts and name in TEXTS and name not in NO_ITEM and imgui.is_item_visible():
            shown.measure(texts[0])
        return result

    return call


def _drawing(shown: Shown, real: Callable[..., Any]) -> Callable[..., Any]:
    def call(draw: imgui.ImDrawList, *args: Any, **options: Any) -> Any:
        shown.texts.update(text for text in (*args, *options.values()) if isinstance(text, str))
        return real(draw, *args, **options)

    return call


def _before(noted: Callable[[], None], real: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **options: Any) -> Any:
        noted()
        return real(*args, **options)

    return call


def _label(text: str) -> str:
    """What imgui shows of a label, without the places of numbers."""
    return FORMAT.sub("", text.partition("##")[0]).strip()
