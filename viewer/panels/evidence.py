"""The evidence panel: the training photos that see the radiance point, with the model's colour and their angle."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, imgui

from nerf_core.common.language import figure, marked, tr, trn
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.probe import RayProbe, Sightings

from ..model.state import Action, AppState, GoToView
from ..ui.contract import PANELS, Ui
from ..ui.widgets import hint, mono, nothing_yet, packed, swatch

PHOTO = 400  # limit for the longer side, in pixels, of the photo shown on hover
SHOWN = 48  # photos in the table: first those that see the point, each group sorted by angle to the ray
THUMBNAIL = 33  # side in pixels; odd, so that the point's pixel is in the middle
COLUMNS = (
    marked("photo"), marked("angle"), marked("light"), marked("photo's"), marked("model's"), marked("off by"), "",
)  # fmt: skip

GAIN = marked("gain")


@PANELS.register("evidence")
class EvidencePanel:
    title = marked("Evidence")
    dock: Literal["bottom_right"] = "bottom_right"
    order = 1

    def __init__(self) -> None:
        self._of: Sightings | None = None
        self._sheet = np.zeros((1, 1, 4), np.uint8)
        self._photo_of: tuple[Scene, int] | None = None
        self._large = self._sheet

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        evidence, scene, ray = state.snapshot.evidence, state.snapshot.scene, state.snapshot.ray
        if evidence is None or scene is None or ray is None:
            text = tr("Click a pixel: here you will see which photos know the point it shows.")
            nothing_yet(ui, state.snapshot.method, text)
            return
        if evidence is not self._of:
            self._of, self._sheet = evidence, _sheet(scene, evidence)
        hint(ui, _summary(evidence))
        if not len(evidence.views):
            return
        flags = imgui.TableFlags_.scroll_y | imgui.TableFlags_.sizing_fixed_fit
        exposed = bool((evidence.gain != 1).any())  # exposures were learnt
        columns = [tr(name) for name in COLUMNS]
        if exposed:
            columns.insert(-1, tr(GAIN))
        if imgui.begin_table("evidence", len(columns), flags, imgui.get_content_region_avail()):
            imgui.table_setup_scroll_freeze(0, 1)
            for name in columns:
                imgui.table_setup_column(name)
            imgui.table_headers_row()
            angles = _angles(evidence, state.camera.c2w()[:, 3])
            order = np.lexsort((angles, ~evidence.seen[:SHOWN])).tolist()
            clipper = imgui.ListClipper()  # of 48 rows a dozen are in sight, and each takes 0.1 ms
            clipper.begin(len(order))
            while clipper.step():
                for k in order[clipper.display_start : clipper.display_end]:
                    yield from self._row(ui, scene, evidence, k, float(angles[k]), ray, exposed)
            imgui.end_table()

    def _photo(self, ui: Ui, scene: Scene, evidence: Sightings, k: int, ray: RayProbe) -> None:
        """The whole photo with the point and the ray's epipolar line."""
        view = int(evidence.views[k])
        if self._photo_of is None or self._photo_of[0] is not scene or self._photo_of[1] != view:
            self._photo_of, self._large = (scene, view), scene.photos.small(view, PHOTO)
        camera = scene.views[view].camera
        if not imgui.begin_tooltip():
            return
        width = 22 * ui.em
        scale = width / camera.width
        size = ImVec2(width, camera.height * scale)
        at = imgui.get_cursor_screen_pos()
        imgui.image(ui.texture("evidence photo", self._large), size)
        draw, color = imgui.get_window_draw_list(), packed(ui.theme.ray)
        draw.push_clip_rect(at, ImVec2(at.x + size.x, at.y + size.y), True)
        line = epipolar(camera, ray) * scale
        for a, b in pairwise(line):
            if np.isfinite(a).all() and np.isfinite(b).all():
                ends = ImVec2(at.x + a[0], at.y + a[1]), ImVec2(at.x + b[0], at.y + b[1])
                draw.add_line(*ends, packed(ui.theme.surface), 0.3 * ui.em)
                draw.add_line(*ends, color, 0.1 * ui.em)
        x, y = evidence.pixels[k] * scale
        draw.add_circle(ImVec2(at.x + x, at.y + y), 0.5 * ui.em, packed(ui.theme.text), thickness=0.12 * ui.em)
        draw.pop_clip_rect()
        imgui.text_unformatted(scene.views[view].name)
        imgui.text_colored(ui.theme.muted, tr("the line is the ray; click to fly there"))
        imgui.end_tooltip()

    def _row(
        self, ui: Ui, scene: Scene, evidence: Sightings, k: int, angle: float, ray: RayProbe, exposed: bool
    ) -> Iterator[Action]:
        imgui.table_next_row()
        imgui.table_next_column()
        side, rows = 2.6 * ui.em, min(len(evidence.views), SHOWN)
        at = imgui.get_cursor_screen_pos()
        texture = ui.texture("evidence", self._sheet, smooth=False)
        imgui.image(texture, ImVec2(side, side), ImVec2(0, k / rows), ImVec2(1, (k + 1) / rows))
        dot, draw = ImVec2(at.x + side / 2, at.y + side / 2), imgui.get_window_draw_list()
        for color, width in ((ui.theme.surface, 0.25 * ui.em), (ui.theme.text, 0.1 * ui.em)):
            draw.add_circle(dot, 0.35 * ui.em, packed(color), thickness=width)
        view = int(evidence.views[k])
        if imgui.is_item_hovered():
            self._photo(ui, scene, evidence, k, ray)
            imgui.set_mouse_cursor(imgui.MouseCursor_.hand)
        if imgui.is_item_clicked():
            yield GoToView(view)
        ui.mark(f"evidence.{k}")
        off = float(np.abs(evidence.observed[k] - evidence.predicted[k]).mean())
        with mono(ui):
            for text in (f"{np.degrees(angle):.0f}°", figure(evidence.transmittance[k], ".2f")):
                imgui.table_next_column()
                imgui.text_unformatted(text)
            for rgb in (evidence.observed[k], evidence.predicted[k]):
                imgui.table_next_column()
                partial(swatch, ui, rgb)()
            imgui.table_next_column()
            imgui.text_unformatted(figure(off, ".3f"))
            if exposed:
                imgui.table_next_column()
                imgui.text_unformatted(figure(float(evidence.gain[k].mean()), ".2f"))
                imgui.set_item_tooltip(_gains(evidence.gain[k]))
            imgui.table_next_column()
            if not evidence.seen[k]:
                imgui.text_colored(ui.theme.muted, tr("hidden"))


def _gains(gain: np.ndarray) -> str:
    """A tooltip about the exposure of a photo with these gains (3,)."""
    text = tr(
        "exposure of the photo as learnt: red × {red}, green × {green}, blue × {blue}; its colour is shown without"
    )
    red, green, blue = (figure(float(v), ".3f") for v in gain)
    return text.format(red=red, green=green, blue=blue)


def _summary(evidence: Sightings) -> str:
    """Which photos see the point, in parts with semicolons between. Each part can stand alone in any language."""
    seen, looked, framed = int(evidence.seen.sum()), len(evidence.views), evidence.framed
    if framed > looked:
        text, of = tr("Of {of} training photos that were asked {seen} see the point"), looked
    else:
        text, of = tr("{seen} of {of} training photos see the point"), evidence.asked
    parts = [text.format(seen=figure(seen, ","), of=figure(of, ","))]
    parts.append(trn("from {n} it is hidden", "from {n} it is hidden", looked - seen))
    if framed > looked:
        parts.append(trn("{n} more have it in their frame", "{n} more have it in their frame", framed - looked))
    if evidence.masked:
        parts.append(trn("{n} has it masked", "{n} have it masked", evidence.masked))
    if evidence.asked > framed + evidence.masked:
        outside = evidence.asked - framed - evidence.masked
        parts.append(trn("{n} have it outside their frame", "{n} have it outside their frame", outside))
    return "; ".join(parts) + "."


def _angles(evidence: Sightings, eye: np.ndarray) -> np.ndarray:
    """Angles in radians, at the point, between the eye (3,) and each of the first SHOWN photos."""
    towards = eye - evidence.point
    distance = float(np.sqrt((towards * towards).sum()))
    if distance == 0:  # an eye at the point has no direction
        return evidence.angle[:SHOWN]
    return np.arccos(np.clip((evidence.directions[:SHOWN] * towards).sum(-1) / distance, -1, 1))


def epipolar(camera: Camera, ray: RayProbe) -> np.ndarray:
    """Return the pixels (P, 2) of a ray in a camera's picture; NaN where the picture does not show it."""
    t = np.geomspace(max(ray.near, 1e-3 * ray.far), max(ray.far, 1e-6), 96)
    pixels, depth = camera.project(ray.origin.astype(np.float64) + t[:, None] * ray.direction.astype(np.float64))
    pixels = np.where(depth[:, None] > 0, pixels, np.nan)
    if camera.lens.wide:  # the line leaves a picture of everything around at one edge and comes back at the other
        pixels[1:][np.abs(np.diff(pixels[:, 0])) > camera.width / 2] = np.nan
    return pixels


def _sheet(scene: Scene, evidence: Sightings) -> np.ndarray:
    """The thumbnails one below the other: uint8 (SHOWN · THUMBNAIL, THUMBNAIL, 4)."""
    count = max(min(len(evidence.views), SHOWN), 1)
    sheet = np.full((count, THUMBNAIL, THUMBNAIL, 4), 255, np.uint8)
    half = THUMBNAIL // 2
    for k, view in enumerate(evidence.views[:SHOWN].tolist()):
        width, height = scene.photos.sizes[view]
        x, y = np.floor(evidence.pixels[k]).astype(int)
        rows = np.clip(
            np.arange(y - half, y + half + 1), 0, height - 1
        )  # beyond the edge the border pixels are repeated
        columns = np.clip(np.arange(x - half, x + half + 1), 0, width - 1)
        sheet[k, ..., :3] = scene.photos.part(view, rows[:, None], columns) >> 8
    return sheet.reshape(-1, THUMBNAIL, 4)
