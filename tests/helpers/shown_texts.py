"""Record the texts that are given to imgui and implot, and what of them does not fit."""

from __future__ import annotations

import gettext
import re
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import pytest
from imgui_bundle import imgui, implot

from nerf_core.common.configs import constants
from nerf_core.methods import METHODS
from viewer.ui.theme import TEXT_PIXELS
from viewer.ui.widgets import Confirmation

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
PLOT_TEXTS |= {"begin_plot": (0,), "end_plot": ()}
AXES = (implot.ImAxis_.x1.value, implot.ImAxis_.y1.value)
# A decimal point, or a format that writes one. (A comma between thousands cannot be told from a decimal one.)
ENGLISH_NUMBER = re.compile(r"(?<![\w.])\d+\.\d|%(?:\.[1-9]\d*)?[feg](?![a-z])")
VERSION = re.compile(r"\b(?:version|OpenGL|torch)\b.*")
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
# What is not translated: files, symbols, keys, options with their values, and names of made-up data.
DATA = re.compile(
    r"Traceback[\s\S]*|\S*/\S*|\w+_\w+|\d+steps|\S+\.(?:png|npy|mp4|json|html|csv|npz|safetensors|md|ply|\w*lab)\b|\b(?:Ctrl|Shift|Space|Tab|Esc|Enter)\b"
    r"|\b(?:auto|all|complete|None|English|Русский|spheres|blender|ball|scripted|chair|photos \\xff|the wall)\b"
    r"|\b(?:PSNR|SSIM|NDC|sin|cos|exp|rgb|RGB|nan|bg|near|far|GPU|CPU|CUDA)\b"
)
OPTIONS = {
    part for name in METHODS.names() for key in constants(METHODS.get(name).constants) for part in key.split(".")
}
NAMES = re.compile("|".join(rf"\b{re.escape(name)}\b" for name in sorted({*METHODS.names(), *OPTIONS}, key=len)[::-1]))
SLACK = 1.5  # pixels: rounding


class Brackets(gettext.NullTranslations):
    """A language that says each text in brackets, so that one shows where a text was not looked up.

    unknown: texts that were looked up, and that no catalogue has, because they are not marked where they stand.
    """

    def __init__(self, known: Container[str] = ()) -> None:
        super().__init__()
        self._known = known
        self.unknown: set[str] = set()

    def gettext(self, message: str) -> str:
        if message not in self._known and outside(message):
            self.unknown.add(message)
        return f"⟦{message}⟧"

    def ngettext(self, msgid1: str, msgid2: str, n: int) -> str:
        if msgid1 not in self._known:
            self.unknown.add(msgid1)
        return f"⟦{msgid1 if n == 1 else msgid2}⟧"


class Cut(NamedTuple):
    """A text that does not fit. pixels: how much of it is hidden at the right."""

    text: str
    pixels: float


class Shown:
    """texts: what was shown. cut: what of it did not fit; forget it after the first frames, in which columns settle.

    english_numbers: texts with a decimal point, formats that make one, and plots that have an axis with implot's own
    ticks.
    """

    def __init__(self) -> None:
        self.texts: set[str] = set()
        self.english_numbers: set[str] = set()
        # The plot being set up, its axes with ticks of ours, and those without numbers.
        self._plot, self._own_ticks, self._bare = "", set[int](), set[int]()
        self.cut: set[Cut] = set()
        self._columns: list[str] = []  # of the table being set up: they are shown if it has a row of headers

    def note(self, name: str, texts: list[str]) -> None:
        if name == "table_setup_column":
            self._columns += texts
        else:
            self.texts.update(texts)

    def numbers(self, name: str, args: tuple[Any, ...], texts: list[str]) -> None:
        """Note the numbers that a call shows in English, whatever the language."""
        if name == "input_text_with_hint":
            return  # an option, as the command line spells it
        self.english_numbers |= {text for text in texts if ENGLISH_NUMBER.search(VERSION.sub("", text))}
        if name == "begin_plot":
            self._plot, self._own_ticks, self._bare = args[0], set(), set()
        elif name == "setup_axis_ticks" and int(args[0]) in self._own_ticks:
            self.english_numbers.add(f"{self._plot} axis {args[0]} twice")  # implot would show both
        elif name == "setup_axis_ticks":
            self._own_ticks.add(int(args[0]))
        elif name == "setup_axis" and len(args) > 2 and args[2] & implot.AxisFlags_.no_tick_labels:
            self._bare.add(int(args[0]))
        elif name == "end_plot":
            self.english_numbers |= {
                f"{self._plot} axis {axis}" for axis in AXES if axis not in self._own_ticks | self._bare
            }

    def headers(self) -> None:
        self.texts.update(self._columns)

    def table(self) -> None:
        self._columns = []

    def measure(self, name: str, text: str) -> None:
        """Note a text whose item reaches beyond what is visible of its window, unless that can be scrolled to."""
        clip = imgui.get_window_draw_list().get_clip_rect_max().x
        window = imgui.internal.get_current_window()
        right = imgui.get_item_rect_max().x
        if name == "selectable":  # it may span all columns
            right = imgui.get_item_rect_min().x + imgui.calc_text_size(text).x
        beyond = right - clip
        if window.scroll_max.x <= 0 and beyond > SLACK * imgui.get_font_size() / TEXT_PIXELS:
            self.cut.add(Cut(text, round(beyond, 1)))


def outside(text: str) -> list[str]:
    """The words of a text that stand outside of brackets and are no data."""
    inner = ""
    while inner != text:
        inner, text = text, re.sub(r"⟦[^⟦⟧]*⟧", "", text)
    text = DATA.sub("", text)
    return re.findall(r"[A-Za-zА-яё]{2,}", NAMES.sub("", text))


@contextmanager
def recorded(*, everything: bool = False) -> Iterator[Shown]:
    """Record what is shown. everything: also what shows only when it is hovered, unfolded or asked."""
    shown = Shown()
    with pytest.MonkeyPatch.context() as patch:
        for module, names in ((imgui, TEXTS), (implot, PLOT_TEXTS)):
            for name, places in names.items():
                patch.setattr(module, name, _recording(shown, name, getattr(module, name), places))
        patch.setattr(imgui.ImDrawList, "add_text", _drawing(shown, imgui.ImDrawList.add_text))
        for name, noted in (("table_headers_row", shown.headers), ("begin_table", shown.table)):
            patch.setattr(imgui, name, _before(noted, getattr(imgui, name)))
        if everything:
            _unfold(patch)
        yield shown


def _unfold(patch: pytest.MonkeyPatch) -> None:
    """Draw all that hovering, a click or a question would show, into the window itself."""
    patch.setattr(implot, "is_plot_hovered", lambda *_: True)
    for name in ("is_item_hovered", "begin_tooltip", "begin_popup", "begin_tab_bar"):
        patch.setattr(imgui, name, lambda *_: True)
    for name in ("begin_menu", "begin_combo", "tree_node", "tree_node_ex"):
        patch.setattr(imgui, name, _instead(getattr(imgui, name), True))
    patch.setattr(imgui, "begin_tab_item", _instead(imgui.begin_tab_item, (True, None)))
    for name in ("tooltip", "popup", "tab_bar", "menu", "combo", "tab_item"):
        patch.setattr(imgui, f"end_{name}", lambda: None)
    for name in ("tree_pop", "close_current_popup"):
        patch.setattr(imgui, name, lambda: None)
    ask = Confirmation._ask

    def asking(self: Confirmation, *args: Any, **options: Any) -> str:
        self.asking = True
        options.pop("needed", None)
        return ask(self, *args[:4], needed=True)

    patch.setattr(Confirmation, "_ask", asking)


def _instead(recording: Callable[..., Any], result: object) -> Callable[..., Any]:
    """Record the texts of a call, and return a result instead of doing it."""
    return partial(recording, instead=result)


def _recording(shown: Shown, name: str, real: Callable[..., Any], places: tuple[int | str, ...]) -> Callable[..., Any]:
    def call(*args: Any, instead: object = None, **options: Any) -> Any:
        found: list[str] = []
        for place in places:
            value = options.get(place) if isinstance(place, str) else args[place] if place < len(args) else None
            found += [value] if isinstance(value, str) else value if isinstance(value, list) else []
        texts = [label for text in found if (label := _label(text))]
        if name == "begin" and len(args) > 2 and args[2] & imgui.WindowFlags_.no_title_bar:
            texts = []
        shown.note(name, texts)
        shown.numbers(name, args, found)
        if instead is not None or name == "set_tooltip":
            return instead
        result = real(*args, **options)
        if texts and name in TEXTS and name not in NO_ITEM and imgui.is_item_visible():
            shown.measure(name, texts[0])
        return result

    return call


def _drawing(shown: Shown, real: Callable[..., Any]) -> Callable[..., Any]:
    def call(draw: imgui.ImDrawList, *args: Any, **options: Any) -> Any:
        texts = [text for text in (*args, *options.values()) if isinstance(text, str)]
        shown.texts.update(texts)
        shown.numbers("add_text", (), texts)
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
