"""The radiance panel: the colour that a point emits in every direction, as a disc towards the viewer and a map."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Literal

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui

from nerf_core.common.language import figure, marked, tr, trn
from nerf_core.common.text import number, triple, vector
from nerf_core.probe import (
    DISC_SIZE,
    SPHERE_COLUMNS,
    SPHERE_ROWS,
    RadianceProbe,
    Sightings,
    Source,
    disc_grid,
    mean_emitted,
    unseen,
)

from ..model.state import Action, AppState, SetDisc, SetPointDepth
from ..ui.contract import PANELS, Ui
from ..ui.widgets import Row, button, figures, hint, mono, nothing_yet, packed, same_line_if_fits, swatch

CAPTIONS = {"viewer": marked("facing its camera"), "normal": marked("around the normal")}
SPHERE_CAPTION = marked("all directions; hatched: unseen")
CHOICES: tuple[tuple[str, Source, str], ...] = (
    (
        marked("This layer"),
        "layer",
        marked("the layer of the point: its samples, mixed by their weights on the ray. It is what one clicked on"),
    ),
    (marked("This point"), "point", marked("the colour that the point alone emits")),
    (
        marked("Whole ray"),
        "ray",
        marked("the pixel if every sample of the ray kept its weight and was looked at from there"),
    ),
)
ZOOM, HATCH = 3, 9  # factor by which the pictures are enlarged; distance of the stripes in enlarged pixels


@dataclass(frozen=True)
class Pictures:
    """The pictures of one probe, made and uploaded once. Directions from which no photo looks are hatched."""

    probe: RadianceProbe
    evidence: Sightings | None
    source: Source
    disc: np.ndarray
    sphere: np.ndarray

    def shows(self, probe: RadianceProbe, evidence: Sightings | None, of: Source) -> bool:
        return self.probe is probe and self.evidence is evidence and self.source == of

    @staticmethod
    def of(probe: RadianceProbe, evidence: Sightings | None, of: Source) -> Pictures:
        far = unseen(probe.directions, evidence)
        count = SPHERE_ROWS * SPHERE_COLUMNS
        hidden = np.zeros((DISC_SIZE, DISC_SIZE), bool)
        hidden[disc_grid()[2]] = far[count:]
        near = _nearest_inside()
        disc = _hatched(probe.disc_image(of)[..., :3][near], hidden[near])
        sphere = _hatched(probe.sphere_image(of), far[:count].reshape(SPHERE_ROWS, SPHERE_COLUMNS))
        return Pictures(probe, evidence, of, disc, sphere)


def _hatched(rgb: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Enlarge colours (h, w, 3) and hatch them where `hidden` (h, w) → uint8 (ZOOM h, ZOOM w, 4), opaque.

    Frames wait for this, so it is fast: both colours of each pixel are computed small and enlarged four bytes at once.
    """
    dark = rgb.mean(-1, keepdims=True) < 0.5  # so that stripes show on any colour
    striped = np.where(hidden[..., None], 0.55 * rgb + np.where(dark, 0.45, 0.0), rgb)
    both = np.full((2, *hidden.shape, 4), 255, np.uint8)
    both[..., :3] = _bytes(np.stack([rgb, striped]))
    plain, stripe = both.view(np.uint32)[..., 0].repeat(ZOOM, 1).repeat(ZOOM, 2)
    return np.where(_stripes(plain.shape), stripe, plain)[..., None].view(np.uint8)


@cache
def _stripes(shape: tuple[int, int]) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    found = (x + y) % HATCH < HATCH // 3
    found.flags.writeable = False
    return found


@PANELS.register("radiance")
class RadiancePanel:
    title = marked("Radiance")
    dock: Literal["bottom_right"] = "bottom_right"
    order = 0

    def __init__(self) -> None:
        self.hovered: tuple[np.ndarray, np.ndarray] | None = None  # direction and colour under the mouse
        self._pictures: Pictures | None = None

    def draw(self, ui: Ui, state: AppState) -> Iterator[Action]:
        probe, evidence = state.snapshot.radiance, state.snapshot.evidence
        if probe is None:
            nothing_yet(ui, state.snapshot.method, _nothing_yet(state), ("trace", "radiance"))
            return
        known, of = self._pictures, shown_of(state, probe)
        if known is None or not known.shows(probe, evidence, of):
            self._pictures = known = Pictures.of(probe, evidence, of)
        yield from self._draw(ui, state, known)
        if self.hovered is not None:
            _tooltip(ui, *self.hovered)

    def _draw(self, ui: Ui, state: AppState, pictures: Pictures) -> Iterator[Action]:
        """Draw the disc, the map beside it (or below in a narrow panel), and the figures under both."""
        probe = pictures.probe
        viewer = _unit(state.camera.c2w()[:, 3] - probe.point)
        yield from _choices(ui, state, probe)
        avail, gap, line = imgui.get_content_region_avail(), ui.em, imgui.get_text_line_height_with_spacing()
        side = max(min(avail.y - line, (avail.x - gap) * 0.36), 5 * ui.em)
        beside = side + gap + 9 * ui.em <= avail.x
        imgui.begin_group()
        self.hovered = _disc(ui, pictures, viewer, min(side, avail.x))
        imgui.push_text_wrap_pos(imgui.get_cursor_pos_x() + side)
        imgui.text_colored(ui.theme.muted, tr(CAPTIONS[probe.around if probe.normal is not None else "viewer"]))
        imgui.pop_text_wrap_pos()
        imgui.end_group()
        if beside:
            imgui.same_line(0, gap)
        imgui.begin_group()
        width = min(imgui.get_content_region_avail().x, 2 * (side if beside else max(avail.y - 7 * line, 4 * ui.em)))
        self.hovered = _sphere(ui, pictures, viewer, width) or self.hovered
        hint(ui, tr(SPHERE_CAPTION))
        imgui.end_group()
        yield from _point(ui, state, probe)
        if state.snapshot.ray is not None and state.snapshot.ray.depth_strongest is None:
            text = tr("The ray met nothing: this point is empty, and its colour is never seen.")
            hint(ui, text, ui.theme.warning)
        _numbers(ui, pictures)
        _sight(ui, pictures.evidence)


def shown_of(state: AppState, probe: RadianceProbe) -> Source:
    """Whose radiance is shown: the user's choice, else the probe's. A point outside all layers has none of a layer."""
    of = state.radiance_of or probe.default
    return "point" if of == "layer" and probe.layer is None else of


def _choices(ui: Ui, state: AppState, probe: RadianceProbe) -> Iterator[Action]:
    """The choices: colours of the layer, the point or the whole ray, and the direction that the disc faces."""
    shown, labels = shown_of(state, probe), [tr(label) for label, _, _ in CHOICES]
    for (label, of, tip), after in zip(CHOICES, [*labels[1:], tr("Normal")], strict=True):
        imgui.begin_disabled(of == "layer" and probe.layer is None)
        if imgui.radio_button(f"{tr(label)}###{of}", shown == of):
            state.radiance_of = of
        imgui.end_disabled()
        ui.mark(f"radiance.{of}")
        imgui.set_item_tooltip(tr(tip))
        same_line_if_fits(after, imgui.get_frame_height())
    around = state.inspect.around if state.inspect is not None else "viewer"
    changed, normal = imgui.checkbox(f"{tr('Normal')}###normal", around == "normal")
    ui.mark("radiance.normal")
    imgui.set_item_tooltip(tr("turn the disc's middle to where the density falls fastest, instead of to the viewer"))
    if changed:
        yield SetDisc("normal" if normal else "viewer")


def _numbers(ui: Ui, pictures: Pictures) -> None:
    """How view-dependent the layer or the point is, and its mean colour over the directions in which photos saw it."""
    probe, layer = pictures.probe, pictures.source == "layer"
    dependence, back = (probe.layer_dependence, probe.layer_back_rgb) if layer else (probe.dependence, probe.back_rgb)
    rows: list[Row] = [(tr("view-dependence"), number(dependence, 3))]
    mean = mean_emitted(pictures.evidence, layer) if pictures.evidence is not None else None
    if mean is not None:
        rows.append((tr("observed mean"), triple(mean), partial(swatch, ui, mean)))
        rows.append((tr("difference here"), vector(back - mean)))  # signed: it has no colour
    if pictures.source == "ray":
        hint(ui, tr("These are of the point alone:"))
    figures(ui, "numbers", rows)


def _point(ui: Ui, state: AppState, probe: RadianceProbe) -> Iterator[Action]:
    """The position of the point, and a button back to the surface if it was moved."""
    imgui.align_text_to_frame_padding()
    imgui.text_colored(ui.theme.muted, "t")
    imgui.same_line()
    with mono(ui):
        imgui.text_unformatted(tr(number(probe.t, 5)))
    moved = state.inspect is not None and state.inspect.point_t is not None
    imgui.same_line()
    tip = tr("Back to the surface. Drag the line in the ray panel to choose another depth.")
    if button(ui, tr("surface"), "radiance.surface", enabled=moved, tip=tip):
        yield SetPointDepth(None)
    figures(ui, "point", [("x", vector(probe.point))])


def _disc(ui: Ui, pictures: Pictures, viewer: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Draw the disc. Returns the direction and the colour under the mouse, else None."""
    probe, low, radius = pictures.probe, imgui.get_cursor_screen_pos(), side / 2
    high, centre = ImVec2(low.x + side, low.y + side), ImVec2(low.x + radius, low.y + radius)
    draw, white = imgui.get_window_draw_list(), packed(ImVec4(1, 1, 1, 1))
    texture = ui.texture("radiance disc", pictures.disc)
    draw.add_image_rounded(texture, low, high, ImVec2(0, 0), ImVec2(1, 1), white, radius)
    draw.add_circle(centre, radius, packed(ui.theme.hairline))
    imgui.invisible_button("disc", ImVec2(side, side))
    ui.mark("radiance.disc")
    hovered = imgui.is_item_hovered()

    origin, scale = np.array([centre.x, centre.y]), np.array([radius, -radius])
    _marks(ui, lambda d: origin + scale * probe.disc_position(d), pictures.evidence, viewer)
    mouse = imgui.get_mouse_pos()
    x, y = (mouse.x - centre.x) / radius, (centre.y - mouse.y) / radius
    if not hovered or x * x + y * y >= 1:
        return None
    direction = np.array([x, y, np.sqrt(1 - x * x - y * y)]) @ probe.axes
    row, column = (min(int((v + 1) / 2 * DISC_SIZE), DISC_SIZE - 1) for v in (-y, x))
    return direction, probe.disc_image(pictures.source)[_nearest_inside()][row, column, :3]


def _sphere(ui: Ui, pictures: Pictures, viewer: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray] | None:
    probe, low, height = pictures.probe, imgui.get_cursor_screen_pos(), width / 2
    imgui.image(ui.texture("radiance sphere", pictures.sphere), ImVec2(width, height))
    ui.mark("radiance.sphere")
    hovered, draw = imgui.is_item_hovered(), imgui.get_window_draw_list()
    draw.add_rect(low, ImVec2(low.x + width, low.y + height), packed(ui.theme.hairline))

    origin, scale = np.array([low.x, low.y]), np.array([width, height])
    _marks(ui, lambda d: origin + scale * probe.sphere_position(d), pictures.evidence, viewer)
    if not hovered:
        return None
    mouse = imgui.get_mouse_pos()
    column, row = (float(np.clip(v, 0, 1 - 1e-9)) for v in ((mouse.x - low.x) / width, (mouse.y - low.y) / height))
    azimuth, polar = 2 * np.pi * column, np.pi * row
    side = np.cross(probe.up, probe.azimuth0)
    around = np.cos(azimuth) * probe.azimuth0 + np.sin(azimuth) * side
    rgb = probe.sphere_image(pictures.source)[int(row * SPHERE_ROWS), int(column * SPHERE_COLUMNS)]
    return np.cos(polar) * probe.up + np.sin(polar) * around, rgb


def _marks(ui: Ui, place: Callable[[np.ndarray], np.ndarray], evidence: Sightings | None, viewer: np.ndarray) -> None:
    """Draw photos that see the point as dots, hollow where something hides it, and the current view as a crosshair.

    place: maps unit directions (..., 3) to screen positions (..., 2), NaN if the picture does not show them.
    """
    draw, r = imgui.get_window_draw_list(), 0.14 * ui.em
    light, dark = packed(ImVec4(1, 1, 1, 0.9)), packed(ImVec4(0, 0, 0, 0.9))  # one of the two shows on any colour
    if evidence is not None:
        for (x, y), seen in zip(place(evidence.directions).tolist(), evidence.seen.tolist(), strict=True):
            if math.isnan(x):
                continue
            at = ImVec2(x, y)
            if seen:
                draw.add_circle_filled(at, 1.6 * r, dark, 8)
                draw.add_circle_filled(at, r, light, 8)
            else:
                draw.add_circle(at, r, light, 8)
    x, y = place(viewer).tolist()
    if math.isnan(x):
        return
    at = ImVec2(x, y)
    reach = 0.55 * ui.em
    for color, weight in ((dark, 0.25 * ui.em), (packed(ui.theme.accent), 0.13 * ui.em)):
        draw.add_circle(at, 0.7 * reach, color, thickness=weight)
        draw.add_line(ImVec2(at.x - reach, at.y), ImVec2(at.x + reach, at.y), color, weight)
        draw.add_line(ImVec2(at.x, at.y - reach), ImVec2(at.x, at.y + reach), color, weight)


def _sight(ui: Ui, evidence: Sightings | None) -> None:
    if evidence is None or not evidence.asked:
        return
    count = int(evidence.seen.sum())
    if not count:
        text = trn(
            "The only training photo does not see this point: its colour is a guess.",
            "None of the {n} training photos sees this point: its colour is a guess.",
            evidence.asked,
        )
        hint(ui, text, ui.theme.warning)
    else:
        text = tr("{seen} of {asked} training photos see it (dots), {framed} have it in frame")
        numbers = {"seen": count, "asked": evidence.asked, "framed": evidence.framed}
        hint(ui, text.format(**{name: figure(n, ",") for name, n in numbers.items()}))


def _tooltip(ui: Ui, direction: np.ndarray, rgb: np.ndarray) -> None:
    if imgui.begin_tooltip():
        rows: list[Row] = [("v", vector(direction)), ("rgb", f" {tr(triple(rgb))}", partial(swatch, ui, rgb))]
        figures(ui, "direction", rows, 16 * ui.em)
        imgui.end_tooltip()


def _nothing_yet(state: AppState) -> str:
    if state.inspect is not None:
        return tr("Looking at this point from all around …")
    return tr("Click a pixel: here you will see the colour that its surface emits in every direction.")


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-12)  # a camera at the point itself has no direction and marks the centre


def _bytes(image: np.ndarray) -> np.ndarray:
    return (np.clip(np.nan_to_num(image), 0, 1) * 255 + 0.5).astype(np.uint8)


@cache
def _nearest_inside() -> tuple[np.ndarray, np.ndarray]:
    """Row and column, for every texel, of a texel inside the disc, so that smoothing adds no black at the edge."""
    x, y, _ = disc_grid()
    shrink = np.minimum(
        1, (1 - 2 / DISC_SIZE) / np.maximum(np.hypot(x, y), 1e-12)
    )  # 1e-12: the centre has radius 0 and stays
    rows, columns = (((v * shrink + 1) / 2 * DISC_SIZE).astype(int) for v in (-y, x))
    return rows, columns
