"""The viewport: the picture, overlays in space, and a text if there is no picture."""

from __future__ import annotations

import textwrap

import moderngl
import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.captures.records import COPYING, STAGES, PoseProgress, thumbnails_of
from nerf_core.common.language import figure, tr
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import Snapshot
from nerf_core.methods import lacking
from nerf_core.probe import RayProbe
from nerf_core.rendering.modes import COLOR, MODES, Mode
from nerf_core.training.pose_records import PoseCorrections

from ..commands.pointer import ViewportInput
from ..commands.registry import USER_COMMANDS, with_keys
from ..draw.growing import GrowingModel
from ..draw.imgui_renderer import ImguiRenderer
from ..draw.mosaic import mosaic
from ..draw.overlays import NEAR, Overlay, axis_directions, frusta, spread_views
from ..draw.photo import NearestPhoto
from ..draw.viewport import ViewportPicture
from ..draw.visits import Ink
from ..model.state import AppState, SampleRef
from ..ui.layout import VIEWPORT, window_name
from ..ui.theme import GREEN, SKY, VERMILION
from ..ui.widgets import STALE, color_scale, faded, packed, sample_tooltip, visit_tooltip
from .panel_host import PanelUi

FRUSTUM_DEPTH = 0.12  # of the scene's radius: visible, but not in front of the scene
PHOTOS_SHARE = 0.65  # of the viewport's height, for photos of which no pose was found: the reason stands below
SHADE = ImVec4(0.0, 0.0, 0.0, 0.6)  # under bright lines and texts, so that they are readable on any picture


class ViewportPanel:
    def __init__(self, context: moderngl.Context, renderer: ImguiRenderer) -> None:
        self._picture = ViewportPicture(context)
        self._renderer = renderer
        self.input = ViewportInput()
        self.stale = False  # whether something is warped
        self._photo, self._photo_name = NearestPhoto(), ""
        self._growing = GrowingModel()
        self._named: list[moderngl.Texture] = []  # the textures that the renderer knows

    def draw(self, ui: PanelUi, state: AppState, alone: bool) -> None:
        """Draw the viewport. alone: it fills the window between the bars."""
        imgui.push_style_var(imgui.StyleVar_.window_padding, ImVec2(0, 0))
        imgui.push_style_var(
            imgui.StyleVar_.window_border_size, 0.0
        )  # a border would cover the picture's outermost pixels
        imgui.push_style_color(imgui.Col_.window_bg, ui.theme.ground)
        flags = imgui.WindowFlags_.no_scrollbar | imgui.WindowFlags_.no_scroll_with_mouse
        if state.snapshot.preview is not None and state.snapshot.posing is None:  # the picture covers the window
            flags |= imgui.WindowFlags_.no_background
        if alone:
            area = imgui.get_main_viewport()
            imgui.set_next_window_pos(area.work_pos)
            imgui.set_next_window_size(area.work_size)
            flags |= imgui.WindowFlags_.no_decoration | imgui.WindowFlags_.no_docking
            flags |= imgui.WindowFlags_.no_saved_settings
        else:
            kind = imgui.WindowClass()
            kind.dock_node_flags_override_set = imgui.internal.DockNodeFlagsPrivate_.no_tab_bar
            imgui.set_next_window_class(kind)
        imgui.begin(f"{VIEWPORT}##alone" if alone else window_name(VIEWPORT), None, flags)
        imgui.pop_style_color()
        imgui.pop_style_var(2)
        self._draw_content(ui, state)
        imgui.end()

    def _draw_content(self, ui: PanelUi, state: AppState) -> None:
        origin, room = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail()
        origin = ImVec2(float(int(origin.x)), float(int(origin.y)))
        width, height = max(int(room.x), 1), max(int(room.y), 1)
        state.viewport = (width, height)
        state.viewport_rect = (origin.x, origin.y, float(width), float(height))
        camera = state.camera.camera(width, height)
        draw = imgui.get_window_draw_list()
        self._draw_picture(ui, draw, state, camera, origin)
        imgui.set_cursor_screen_pos(origin)
        buttons = imgui.ButtonFlags_
        every = buttons.mouse_button_left | buttons.mouse_button_right | buttons.mouse_button_middle
        imgui.invisible_button("canvas", ImVec2(width, height), every)
        ui.mark("viewport")
        active, hovered = imgui.is_item_active(), imgui.is_item_hovered()
        self.input.pointer(state, (origin.x, origin.y), active, hovered, ui.em)
        scene, ray = state.snapshot.scene, state.snapshot.ray
        if scene is not None and state.snapshot.posing is None:
            overlay = Overlay(draw, camera, (origin.x, origin.y), NEAR * state.camera.distance)
            self._draw_space(ui, state, scene, overlay)
            if ray is not None and state.show_samples and hovered and not active:
                _point_at(ui, state, overlay, ray)
        self._draw_words(ui, state, draw, origin, ImVec2(width, height))

    def _draw_picture(
        self, ui: PanelUi, draw: imgui.ImDrawList, state: AppState, camera: Camera, origin: ImVec2
    ) -> None:
        snapshot = state.snapshot
        preview, scene, posing = snapshot.preview, snapshot.scene, snapshot.posing
        if posing is not None and posing.growing is not None and len(posing.growing.poses):
            self.stale, self._photo_name = False, ""
            self._growing.draw(ui, draw, origin, (camera.width, camera.height), posing.growing, state.time)
            return
        if posing is not None and posing.thumbnails:
            self.stale, self._photo_name = False, ""
            _draw_photos(ui, posing, origin, (camera.width, camera.height))
            return
        if snapshot.status == "empty" and state.unposed is not None and not state.show_left_off:
            _draw_photos(ui, state.unposed, origin, (camera.width, PHOTOS_SHARE * camera.height))
        self.stale, self._photo_name = False, ""
        for texture in self._named:
            self._renderer.remove(texture)
        self._named.clear()
        if scene is not None and preview is None and snapshot.status != "failed":
            self._photo_name = self._photo.draw(ui, draw, scene, camera, origin)
        if preview is None or scene is None:
            self._picture.forget()
            return
        self.stale = self._picture.draw(preview, camera, scene.background, state.time)
        self._named = [layer.texture for layer in self._picture.shown]
        far = ImVec2(origin.x + camera.width, origin.y + camera.height)
        for k, (texture, first, last, alpha, content) in enumerate(self._picture.shown):
            image, tint = self._renderer.add(texture, k == 0, content), packed(ImVec4(1.0, 1.0, 1.0, alpha))
            draw.add_image(image, origin, far, ImVec2(*first), ImVec2(*last), tint)

    def _draw_space(self, ui: PanelUi, state: AppState, scene: Scene, overlay: Overlay) -> None:
        theme, thin = ui.theme, max(1.0, ui.em / 14)
        if state.show_cameras:
            train = set(scene.split("train"))
            depth = FRUSTUM_DEPTH * scene.radius
            shown = spread_views(len(scene.views))
            for trained, color in ((True, theme.text), (False, theme.muted)):
                cameras = [scene.views[k].camera for k in shown if (k in train) is trained]
                if cameras:
                    shade = faded(SHADE, 0.5), 2.5 * thin  # so that lines show on a white background
                    overlay.lines(*frusta(cameras, depth), shade, (faded(color, 0.55), thin))
            if state.snapshot.corrections is not None:
                _draw_corrections(ui, scene, state.snapshot.corrections, overlay)
        if not state.show_samples:
            return
        pinned = [(pin, pin.ray) for pin in state.snapshot.pins if pin.ray is not None and not pin.hidden]
        colors, names = [theme.pins[pin.color] for pin, _ in pinned], [pin.name for pin, _ in pinned]
        _draw_rays(ui, overlay, [ray for _, ray in pinned], colors)
        overlay.tags(*_ends([ray for _, ray in pinned]), names, ui.em, colors, theme.ground)
        ray = state.snapshot.ray
        if ray is None:
            return
        pin = next((pin for pin in state.snapshot.pins if pin.id == state.snapshot.opened_id), None)
        color = theme.ray if pin is None else theme.pins[pin.color]
        _draw_rays(ui, overlay, [ray], [color])
        if not ray.passes:
            marked = state.sample.at if state.sample is not None else None
            overlay.visits(ray, ui.em, Ink(color, theme.ground, theme.text), marked)
            # without any place, the mark at the far end shows at least which pixel is open
            place = ray.origin + (ray.far if ray.depth_expected is None else ray.depth_expected) * ray.direction
            overlay.point(place, 1.15 * ui.em, SHADE)
            overlay.point(place, ui.em, theme.point)
        if state.sample is not None and state.sample.one < len(ray.passes):
            one = ray.passes[state.sample.one]
            if state.sample.at < len(one.t):
                place = ray.origin + float(one.t[state.sample.at]) * ray.direction
                overlay.ring(place, 0.8 * ui.em, SHADE, 3 * thin)
                overlay.ring(place, 0.8 * ui.em, theme.text, 1.5 * thin)
        radiance = state.snapshot.radiance
        if radiance is not None:
            overlay.point(radiance.point, 1.15 * ui.em, SHADE)
            overlay.point(radiance.point, ui.em, theme.point)

    def _draw_words(self, ui: PanelUi, state: AppState, draw: imgui.ImDrawList, origin: ImVec2, size: ImVec2) -> None:
        snapshot = state.snapshot
        if snapshot.posing is not None and snapshot.posing.growing is not None:
            return  # the growing model is the picture
        if snapshot.posing is not None and snapshot.posing.thumbnails:
            corner = ImVec2(origin.x + 0.6 * ui.em, origin.y + size.y - 0.6 * ui.em)
            _chip(ui, draw, corner, size.x, tr(snapshot.loading))
            return
        if self._photo_name:
            words = tr("photo {name}: the first picture is on its way").format(name=self._photo_name)
            words = f"{icons.ICON_FA_IMAGE}  {words}"
            _chip(ui, draw, ImVec2(origin.x + 0.6 * ui.em, origin.y + size.y - 0.6 * ui.em), size.x, words)
            return
        if snapshot.preview is None and state.show_left_off and snapshot.status == "empty":
            return  # the offer to continue says what can be opened
        if snapshot.preview is None:
            below = snapshot.status == "empty" and state.unposed is not None and state.unposed.thumbnails
            _centred(ui, draw, origin, size, _why_empty(state), (1 + PHOTOS_SHARE) / 2 if below else 0.5)
            return
        words = []
        if self.stale:
            words.append(f"{icons.ICON_FA_CLOCK}  {tr(STALE)}")
        elif snapshot.preview.complete and state.camera.moved and _sees_nothing(snapshot):
            reset = with_keys(tr(USER_COMMANDS.get("camera.reset").title), "camera.reset")
            words.append(tr("Nothing is seen from here. {command}").format(command=reset))
        if snapshot.preview.quality == "coarse" and snapshot.coarse:
            words.append(tr(snapshot.coarse))
        if snapshot.stage:
            words.append(tr(snapshot.stage))
        if words:
            corner = ImVec2(origin.x + 0.6 * ui.em, origin.y + size.y - 0.6 * ui.em)
            _chip(ui, draw, corner, size.x, "  ·  ".join(words))
        if snapshot.preview.mode != COLOR:
            _scale(ui, draw, ImVec2(origin.x + 0.6 * ui.em, origin.y + 0.6 * ui.em), MODES.get(snapshot.preview.mode))
        if state.show_cameras and snapshot.scene is not None:
            place = ImVec2(origin.x + size.x - 3 * ui.em, origin.y + size.y - 3 * ui.em)
            _axes(ui, draw, place, state.camera.camera(int(size.x), int(size.y)), snapshot.scene.up)

    @property
    def fading(self) -> bool:
        """Whether the next frame shows another picture even if nothing new comes."""
        return self._picture.fading

    def release(self) -> None:
        self._picture.release()


def _draw_corrections(ui: PanelUi, scene: Scene, found: PoseCorrections, overlay: Overlay) -> None:
    """Draw where moved cameras stood in the capture, and lines from there to where they stand now."""
    gone = np.flatnonzero((found.turned > 0) | (found.shifted > 0))
    if not len(gone):
        return
    thin, shade = max(1.0, ui.em / 14), (faded(SHADE, 0.3), max(1.0, ui.em / 14))
    before = [scene.views[found.views[n]].camera.moved(found.given[n]) for n in gone]
    overlay.lines(*frusta(before, FRUSTUM_DEPTH * scene.radius), shade, (faded(ui.theme.warning, 0.6), thin))
    now = scene.poses[found.views[gone], :, 3]
    overlay.lines(found.given[gone, :, 3], now, shade, (faded(ui.theme.warning, 0.9), 2 * thin))


def _point_at(ui: PanelUi, state: AppState, overlay: Overlay, ray: RayProbe) -> None:
    """Show the numbers of the sample under the mouse, and mark it in all panels."""
    mouse = imgui.get_mouse_pos()
    if not ray.passes:
        visit = overlay.visit_at(ray, ui.em, mouse.x, mouse.y)
        if visit is not None:
            state.pointed_at = SampleRef(0, visit)
            visit_tooltip(ui, ray, visit)
        return
    k = overlay.sample_at(ray, ui.em, mouse.x, mouse.y)
    if k is not None:
        state.pointed_at = SampleRef(len(ray.passes) - 1, k)
        sample_tooltip(ui, ray.last, k)


def _draw_rays(ui: PanelUi, overlay: Overlay, rays: list[RayProbe], colors: list[ImVec4]) -> None:
    thin = max(1.0, ui.em / 14)
    overlay.lines(*_ends(rays), (SHADE, 3 * thin), (colors, 1.2 * thin))
    sampled = [n for n, ray in enumerate(rays) if ray.passes]
    rims = (SHADE, 2.2 * thin), ([colors[n] for n in sampled], 1.4 * thin)
    overlay.samples([rays[n] for n in sampled], ui.em, *rims)
    for ray, color in zip(rays, colors, strict=True):
        if not ray.passes:  # a model gives all of its rays samples, or none
            overlay.visits(ray, ui.em, Ink(color, SHADE, color), numbered=False)


def _sees_nothing(snapshot: Snapshot) -> bool:
    """Whether the picture shows nothing but background: of a method with samples, no pixel has a depth."""
    preview = snapshot.preview
    return preview is not None and not lacking(snapshot.method, "trace") and bool(np.isnan(preview.depth).all())


def _ends(rays: list[RayProbe]) -> tuple[np.ndarray, np.ndarray]:
    """The ends of the rays in the world, (N, 3) each."""
    places = [(ray.origin + ray.near * ray.direction, ray.origin + ray.far * ray.direction) for ray in rays]
    starts, ends = np.array(places, np.float64).reshape(-1, 2, 3).transpose(1, 0, 2)
    return starts, ends


def _why_empty(state: AppState) -> tuple[str, str]:
    """The text for a viewport without a picture: a line, and a quieter one under it."""
    snapshot = state.snapshot
    match snapshot.status:
        case "loading":
            return tr("Opening"), tr(snapshot.loading)
        case "failed":
            return tr("No picture: the worker failed"), tr("see Notices")
        case "empty":
            keys = ", ".join(USER_COMMANDS.get("file.open").keys)
            if state.not_opened:
                another = tr("{keys} opens another folder of photos").format(keys=keys)
                return tr("Nothing is open"), f"{tr(state.not_opened)}\n{another}"
            return tr("Nothing is open"), tr("{keys} opens a folder of photos").format(keys=keys)
        case _:
            return tr("The first picture is on its way"), ""


def _draw_photos(ui: PanelUi, posing: PoseProgress, origin: ImVec2, room: tuple[float, float]) -> None:
    """Draw the photos of a search for poses. Those in which features are still to be found are dim."""
    reading, looking = posing.stage == COPYING, posing.stage == STAGES["features"]
    count = len(thumbnails_of(posing.total)) if reading else len(posing.thumbnails)
    seen = 0.0 if reading else posing.done / max(posing.total, 1) if looking else 1.0
    mosaic(ui, posing.thumbnails, count, seen, origin, room)


def _centred(
    ui: PanelUi, draw: imgui.ImDrawList, origin: ImVec2, size: ImVec2, lines: tuple[str, str], height: float
) -> None:
    """A line, and quieter ones under it, which are wrapped to the viewport's width. height: a share of its height."""
    room = max(int((size.x - 2 * ui.em) / (0.5 * ui.em)), 20)  # letters; few are wider than half an em
    quiet = [part for line in lines[1].splitlines() for part in textwrap.wrap(line, room)]
    y = origin.y + height * size.y - ui.em
    for line, color in [(lines[0], ui.theme.text), *((part, ui.theme.muted) for part in quiet)]:
        width = imgui.calc_text_size(line).x
        x = origin.x + max(0.5 * (size.x - width), 0.5 * ui.em)
        draw.add_text(ImVec2(int(x), int(y)), packed(color), line)
        y += 1.5 * ui.em


def _chip(ui: PanelUi, draw: imgui.ImDrawList, corner: ImVec2, room: float, words: str) -> None:
    """A text on a dark background, in several lines where the viewport is narrow. corner: the lower left one."""
    pad = 0.45 * ui.em
    letter = imgui.calc_text_size(words).x / len(words)
    text = "\n".join(textwrap.wrap(words, max(int((room - 1.2 * ui.em - 2 * pad) / letter), 1)))
    size = imgui.calc_text_size(text)
    place = ImVec2(corner.x, corner.y - size.y - pad)
    draw.add_rect_filled(place, ImVec2(corner.x + size.x + 2 * pad, corner.y), packed(SHADE), 0.2 * ui.em)
    draw.add_text(ImVec2(int(place.x + pad), int(place.y + 0.5 * pad)), packed(ui.theme.text), text)


def _scale(ui: PanelUi, draw: imgui.ImDrawList, place: ImVec2, mode: type[Mode]) -> None:
    """A mode's name and its colour scale."""
    more = tr("{number} or more").format(number=figure(mode.high, "g"))
    words = f"{tr(mode.label)}   {figure(mode.low, 'g')}", more
    widths = [imgui.calc_text_size(text).x for text in words]
    pad, bar, high = 0.45 * ui.em, 8 * ui.em, imgui.get_text_line_height()
    far = ImVec2(place.x + sum(widths) + bar + 4 * pad, place.y + high + pad)
    draw.add_rect_filled(place, far, packed(SHADE), 0.2 * ui.em)
    y, x = place.y + 0.5 * pad, place.x + pad
    text = packed(ui.theme.text)
    draw.add_text(ImVec2(x, y), text, words[0])
    x += widths[0] + pad
    color_scale(draw, ImVec2(x, y + 0.15 * high), ImVec2(x + bar, y + 0.85 * high), mode.colors)
    draw.add_text(ImVec2(x + bar + pad, y), text, words[1])


def _axes(ui: PanelUi, draw: imgui.ImDrawList, centre: ImVec2, camera: Camera, up: np.ndarray) -> None:
    """The world axes x, y, z. Those that point away are drawn first, under the others."""
    named = zip(axis_directions(camera, up), "xyz", (VERMILION, GREEN, SKY), strict=True)
    for (direction, towards, is_up), name, color in sorted(named, key=lambda item: item[0][1]):
        strong = packed(ImVec4(color.x, color.y, color.z, 1.0 if towards > -0.2 else 0.5))
        tip = ImVec2(centre.x + 1.6 * ui.em * direction[0], centre.y + 1.6 * ui.em * direction[1])
        draw.add_line(centre, tip, strong, max(1.0, ui.em / (6 if is_up else 10)))
        size = imgui.calc_text_size(name)
        out = ImVec2(centre.x + 2.2 * ui.em * direction[0], centre.y + 2.2 * ui.em * direction[1])
        draw.add_text(ImVec2(out.x - size.x / 2, out.y - size.y / 2), strong, name)
