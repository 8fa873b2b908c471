"""What the page about encodings learns: the built-in picture, the reader's drawing, or a photo."""

from __future__ import annotations

import threading
from functools import cache
from pathlib import Path

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.common.errors import UserError
from nerf_core.common.language import tr
from nerf_core.common.user_paths import own_path
from nerf_core.lab.sample_photo import sample_photo
from nerf_core.rendering.video import write_png

from ..draw.paint_canvas import SIDE, PaintCanvas, blank, checker, stripes
from ..ui.contract import Ui
from ..ui.study_page import StudyFolders
from ..ui.widgets import button, color_of, field_beside, field_width, hint, same_line_for, same_line_if_fits

COLORS = ("000000", "ffffff", "7f7f7f", "d55e00", "e69f00", "f0e442", "009e73", "56b4e9", "0072b2", "cc79a7")
BRUSH = 1.0, 32.0  # pixels
LEAST_EM, TOOLS_EM = 8.0, 17.0  # least side of the canvas, least width of what lies beside it
MOST_TOOLS_EM = 26.0
DRAWING = "drawing.png"


class _BuiltIn:
    """The picture that the study draws if it gets no photo, smaller. A thread draws it: that takes some 0.5 s."""

    def __init__(self) -> None:
        self.image: np.ndarray | None = None
        threading.Thread(target=self._draw, name="sample photo", daemon=True).start()

    def _draw(self) -> None:
        self.image = np.round(255 * sample_photo(SIDE)).astype(np.uint8)


@cache
def built_in() -> _BuiltIn:
    """Return it; the first call begins to draw it."""
    return _BuiltIn()


class Source:
    """What is learnt next, and the widgets that choose it.

    photo: its file; None: the built-in picture.
    canvas: what the reader paints.
    problem: why a photo or a drawing cannot be taken; empty: nothing is wrong.
    """

    def __init__(self, folders: StudyFolders) -> None:
        """folders: where a drawing is kept."""
        self.photo: Path | None = None
        self.canvas = PaintCanvas()
        self.problem = ""
        self._path = ""
        self._folders = folders

    @property
    def preview(self) -> np.ndarray | None:
        """Return what is learnt next (h, w, 3) uint8; None for a photo, and until the built-in picture is drawn."""
        if self.photo is None:
            return built_in().image
        return self.canvas.pixels if self.photo.name == DRAWING else None

    def draw(self, ui: Ui, obstacle: str) -> bool:
        """Draw the canvas with its tools. Returns True in the frame in which something is chosen to be learnt.

        obstacle: why nothing can be learnt now; empty: it can.
        """
        room = imgui.get_content_region_avail()
        side = max(min(room.y, room.x - TOOLS_EM * ui.em), LEAST_EM * ui.em)
        self.canvas.draw(ui, float(int(side)), "encoding.canvas")
        if room.x - side > 0.6 * TOOLS_EM * ui.em:
            imgui.same_line(0, ui.em)
        width = min(imgui.get_content_region_avail().x, MOST_TOOLS_EM * ui.em)
        imgui.begin_child("tools", ImVec2(width, 0), imgui.ChildFlags_.auto_resize_y)
        self._tools(ui)
        imgui.dummy(ImVec2(0, 0.2 * ui.em))
        chosen = self._choices(ui, obstacle)
        imgui.end_child()
        return chosen

    # ---- pieces -------------------------------------------------------------------------------------------------

    def _tools(self, ui: Ui) -> None:
        canvas = self.canvas
        size = imgui.get_frame_height()
        for k, code in enumerate(COLORS):
            if k:
                same_line_for(size, 0.25 * ui.em)
            red, green, blue = bytes.fromhex(code)
            if _color(ui, code, size, chosen=(red, green, blue) == canvas.color):
                canvas.color = red, green, blue
        label = tr("brush")
        field_width(ui, label)
        _, canvas.brush = imgui.slider_float(f"{label}##encoding.brush", canvas.brush, *BRUSH, "%.0f")
        ui.mark("encoding.brush")
        pictures = (
            (tr("Clear"), "clear", blank),
            (tr("Stripes"), "stripes", stripes),
            (tr("Checker"), "checker", checker),
        )
        for k, (name, mark, make) in enumerate(pictures):
            if k:
                same_line_if_fits(name)
            if button(ui, name, f"encoding.{mark}"):
                canvas.replace(make())
        back = tr("Undo")
        same_line_if_fits(back)
        if button(ui, back, "encoding.undo", enabled=canvas.can_undo):
            canvas.undo()

    def _choices(self, ui: Ui, obstacle: str) -> bool:
        """Draw the buttons that choose what is learnt. Returns whether one was pressed and the picture can be had."""
        empty = tr("Paint something first.") if self.canvas.plain else ""
        tip, learn = obstacle or empty, f"{icons.ICON_FA_PAINTBRUSH}  {tr('Learn my drawing')}"
        drawn = button(ui, learn, "encoding.learn_drawing", enabled=not tip, tip=tip)
        label = tr("Learn the built-in picture")
        same_line_if_fits(label)
        built = button(ui, label, "encoding.learn_built_in", enabled=not obstacle, tip=obstacle)
        label = tr("Learn this photo")
        field_beside(ui, label)
        _, self._path = imgui.input_text_with_hint("##encoding.path", tr("or a photo's file"), self._path)
        ui.mark("encoding.path")
        imgui.same_line()
        path = self._path.strip()
        tip = obstacle or ("" if path else tr("Type the path of a photo on the left."))
        opened = button(ui, label, "encoding.learn_photo", enabled=not tip, tip=tip)
        if self.problem:
            hint(ui, self.problem, ui.theme.error)
        try:
            if drawn:
                self.photo = self._saved()
            elif opened:
                self.photo = own_path(Path(path))
            elif built:
                self.photo = None
        except (UserError, OSError) as error:
            self.problem = str(error)
            return False
        if drawn or opened or built:
            self.problem = ""
        return drawn or opened or built

    def _saved(self) -> Path:
        """Write the drawing, and return its file. Raises UserError or OSError."""
        file = self._folders.kept("drawing") / DRAWING
        write_png(file, self.canvas.pixels)
        return file


def _color(ui: Ui, code: str, size: float, chosen: bool) -> bool:
    """Draw a colour to choose, with a frame around the one that is."""
    corner = imgui.get_cursor_screen_pos()
    pressed = imgui.invisible_button(f"encoding.color.{code}", ImVec2(size, size))
    ui.mark(f"encoding.color.{code}")
    far, inset = ImVec2(corner.x + size, corner.y + size), max(1.0, ui.em / 6)
    draw, pack = imgui.get_window_draw_list(), imgui.color_convert_float4_to_u32
    low, high = ImVec2(corner.x + inset, corner.y + inset), ImVec2(far.x - inset, far.y - inset)
    draw.add_rect_filled(low, high, pack(color_of(np.frombuffer(bytes.fromhex(code), np.uint8) / 255)))
    edge: ImVec4 = ui.theme.accent if chosen else ui.theme.text if imgui.is_item_hovered() else ui.theme.hairline
    draw.add_rect(corner, far, pack(edge), 0, max(1.0, ui.em / (8 if chosen else 16)))
    return pressed
