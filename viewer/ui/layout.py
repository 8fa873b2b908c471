"""The layout of the panels: the default one, and the user's own, which is remembered between runs."""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Sequence
from pathlib import Path

from imgui_bundle import ImVec2, ImVec4, imgui

from nerf_core.common.language import languages, marked, phrase, tr

from .contract import Panel
from .layout_scale import EMS, READABLE_EM, em_of_menu, fitted

VIEWPORT = marked("Viewport")
HEADER = "; nerf-viewer layout 1 "
FRONT = "; in front: "  # imgui reads it as a comment
EM = "; em: "  # the size of text in pixels: another screen may have another scale
LANGUAGE = "; language: "  # the one that the user has chosen
NOWHERE = "Pos=60,60\n"
RIGHT_EM, BOTTOM_EM = READABLE_EM
BOTTOM_RIGHT_EM = RIGHT_EM
BOTTOM_SHARE = 0.34  # least share of the height: a tall window has taller plots, not only a taller picture
MIDDLE_EM = 23.9  # the second panel of the right column holds plots and buttons of fixed height
TOP_SHARE = 0.47  # share of the column's rest for the panel above it; the last panels get the remainder as tabs


def window_name(title: str) -> str:
    """Return what a panel's window is called: imgui shows what is before ###, and knows it by what is after it.

    title: the panel's, in English. In any language, docks and stored layouts find the window by it.
    """
    return f"{tr(title)}###{title}"


class Layout:
    """The docks.

    file: the file that stores them; None: nothing is read or written.
    language: the code of the language that the user has chosen, which is stored, too; empty: none yet.
    """

    def __init__(self, file: Path | None) -> None:
        self.language = ""
        self._file = file
        self._em = 0.0  # the size of text that the docks are made for; 0: there are none yet
        self._stored = ""
        self._build_next = True
        self._raise_next: tuple[str, ...] = ()  # windows whose tabs come to the front in the next frame
        self._raise_soon: tuple[str, ...] = ()  # windows that must exist first
        self._remembered = ""
        self._front: tuple[str, ...] = ()  # the panels that were in front of others in the last frame

    def load(self) -> str | None:
        """Read the stored layout, which `fit` then shows. Returns a warning if the file is damaged."""
        imgui.get_io().set_ini_filename(None)  # imgui writes nothing by itself
        if self._file is None or not self._file.exists():
            return None
        try:
            header, _, body = self._file.read_text("utf-8").partition("\n")
            if header != f"{HEADER}{_checksum(body)}":
                raise ValueError("damaged")
        except (OSError, ValueError) as error:  # UnicodeDecodeError is a ValueError
            backup = self._file.with_suffix(".bad")
            try:
                self._file.replace(backup)
            except OSError as failure:
                words = marked("{file}: the window layout cannot be read ({error}); the default is shown")
                return phrase(words, file=self._file, error=f"{error}; {failure}")
            words = marked("{file}: the window layout was damaged; the default is shown, the old file is {backup}")
            return phrase(words, file=self._file, backup=backup.name)
        self._stored = body
        self.language = _language_of(body)
        self._build_next = False
        return None

    def fit(self, em: float, window: tuple[int, int]) -> None:
        """Fit the docks to a size of text. Call it before the first frame, and where the screen's scale changes.

        em: the size of text in pixels. window: the window's size in pixels.
        """
        text, old = (self._text(), self._em) if self._em else (self._stored, _em_of(self._stored))
        self._em, self._stored = em, ""
        if text and not self._build_next:
            imgui.load_ini_settings_from_memory(text if old in (None, em) else fitted(text, old, em, window))
            self._remembered = text

    def save_if_changed(self) -> str | None:
        """Write the layout if it changed. Returns a warning if that fails, and does not try again."""
        io = imgui.get_io()
        if not io.want_save_ini_settings:
            return None
        io.want_save_ini_settings = False
        return self.save()

    def save(self) -> str | None:
        """Write the layout now. Returns a warning if that fails."""
        if self._file is None or not self._em:
            return None
        body = self._text()
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            part = self._file.with_suffix(f".{os.getpid()}.part")
            part.write_text(f"{HEADER}{_checksum(body)}\n{body}", "utf-8")
            part.replace(self._file)
        except OSError as error:
            file, self._file = self._file, None
            return phrase("{file}: the window layout cannot be kept ({error})", file=file, error=error.strerror)
        return None

    def _text(self) -> str:
        chosen = f"{LANGUAGE}{self.language}\n" if self.language else ""
        return f"{FRONT}{'|'.join(self._front)}\n{EM}{self._em:g}\n{chosen}{imgui.save_ini_settings_to_memory()}"

    def reset(self) -> None:
        """Show the default layout from the next frame on."""
        self._build_next = True

    def dock(self, panels: Sequence[Panel], em: float, front: tuple[str, ...]) -> None:
        """Make the dock space between the bars. Call it before the panels' windows.

        front: the titles of the panels that were not behind another's tab in the last frame.
        """
        self._front = front or self._front
        area = imgui.get_main_viewport()
        space = imgui.get_id("docks")
        if self._remembered:  # it may come from another version: a panel without a place would float over the others
            places = {panel.title for panel in panels if panel.dock != "overlay"} | {VIEWPORT}
            self._build_next = not all(_has_place(self._remembered, title) for title in places)
            first = self._remembered.partition("\n")[0]
            self._front = tuple(first.removeprefix(FRONT).split("|")) if first.startswith(FRONT) else ()
            self._raise_soon, self._remembered = self._front, ""
        elif self._raise_soon:  # imgui shows the last tab submitted, not the one that was in front
            self._raise_next, self._raise_soon = self._raise_soon, ()
        if self._build_next and area.work_size.x > 0 and area.work_size.y > 0:
            self._build_next = False
            self._raise_next = _build(space, panels, area.work_size, em)
        elif self._raise_next:
            for title in self._raise_next:
                imgui.set_window_focus(title)
            self._raise_next = ()
        # nothing is painted under the docks, because in software GL that would take a quarter of the frame
        imgui.push_style_color(imgui.Col_.window_bg, ImVec4(0, 0, 0, 0))
        imgui.dock_space_over_viewport(space, area)
        imgui.pop_style_color()

    @property
    def raising(self) -> bool:
        """True if the next frame brings tabs to the front."""
        return bool(self._raise_next or self._raise_soon)

    def bring_forward(self, titles: Sequence[str]) -> None:
        """Bring these tabs to the front in the next frame, because docks that return show their last tab."""
        self._raise_next = tuple(titles)


def in_docks() -> bool:
    """Return whether the current window is docked in the main window, directly over the cleared framebuffer."""
    node = imgui.internal.get_window_dock_node()
    return node is not None and imgui.internal.dock_node_get_root_node(node).is_dock_space()


def _has_place(body: str, title: str) -> bool:
    """Whether a stored layout has a place for a window. imgui lets a window without one float at NOWHERE."""
    _, found, after = body.partition(f"[Window][{title}]\n")
    section = after.partition("\n\n")[0]
    return bool(found) and ("DockId=" in section or NOWHERE not in section)


def _em_of(body: str) -> float | None:
    """The size of text with which a layout was stored; None if it is not known."""
    found = re.search(rf"^{EM}(\d+(?:\.\d+)?)$", body, re.MULTILINE)
    em = float(found[1]) if found else em_of_menu(body)
    return em if em in EMS else None


def _language_of(body: str) -> str:
    """The language that was chosen when a layout was stored; empty if none was, or if it has no catalogue any more."""
    found = re.search(rf"^{LANGUAGE}(\S+)$", body, re.MULTILINE)
    return found[1] if found and found[1] in languages() else ""


def _checksum(body: str) -> str:
    return f"{zlib.crc32(body.encode()):08x}"


def _build(space: int, panels: Sequence[Panel], size: ImVec2, em: float) -> tuple[str, ...]:
    """Build the default layout. Returns the first title of each group of tabs, because imgui shows the last."""
    docks = imgui.internal
    docks.dock_builder_remove_node(space)
    docks.dock_builder_add_node(space, imgui.internal.DockNodeFlagsPrivate_.dock_space)
    docks.dock_builder_set_node_size(space, size)
    right = docks.dock_builder_split_node(space, imgui.Dir.right, _share(RIGHT_EM * em, size.x))
    rest = right.id_at_opposite_dir
    bottom = docks.dock_builder_split_node(rest, imgui.Dir.down, max(_share(BOTTOM_EM * em, size.y), BOTTOM_SHARE))
    left_width = size.x * (1 - _share(RIGHT_EM * em, size.x))
    corner = docks.dock_builder_split_node(bottom.id_at_dir, imgui.Dir.right, _share(BOTTOM_RIGHT_EM * em, left_width))
    docks.dock_builder_dock_window(VIEWPORT, bottom.id_at_opposite_dir)
    first = []
    for place, node in (("bottom", corner.id_at_opposite_dir), ("bottom_right", corner.id_at_dir)):
        titles = [panel.title for panel in panels if panel.dock == place]
        for title in titles:
            docks.dock_builder_dock_window(title, node)
        first += titles[:1]
    middle = _share(MIDDLE_EM * em, size.y)
    rooms = (TOP_SHARE * (1 - middle), middle)
    first.append(_stack(right.id_at_dir, [panel.title for panel in panels if panel.dock == "right"], rooms))
    docks.dock_builder_finish(space)
    return tuple(title for title in first if title)


def _stack(node: int, titles: list[str], rooms: Sequence[float]) -> str:
    """Stack windows in shares of the height; the others become tabs in the rest. Returns the first tab's title."""
    left = 1.0
    for room in rooms:
        if len(titles) < 2:
            break
        split = imgui.internal.dock_builder_split_node(node, imgui.Dir.up, room / left)
        imgui.internal.dock_builder_dock_window(titles.pop(0), split.id_at_dir)
        node, left = split.id_at_opposite_dir, left - room
    for title in titles:
        imgui.internal.dock_builder_dock_window(title, node)
    return titles[0] if titles else ""


def _share(wanted: float, whole: float) -> float:
    """The share of a side, at most half, so that the picture has space even in a tiny window."""
    return min(wanted / max(whole, 1.0), 0.5)
