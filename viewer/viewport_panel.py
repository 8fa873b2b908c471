"""The viewport: the picture, what lies in space over it, and words where there is no picture."""

from __future__ import annotations

import moderngl
import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui
from imgui_bundle import icons_fontawesome_6 as icons

from nerf_core.cameras import Camera
from nerf_core.scene import Scene
from viewer.draw.imgui_renderer import ImguiRenderer
from viewer.draw.overlays import NEAR, Overlay, axis_directions, frusta
from viewer.draw.viewport import ViewportPicture
from viewer.interaction import ViewportInput
from viewer.layout import VIEWPORT
from viewer.panel_host import PanelUi
from viewer.state import AppState
from viewer.theme import GREEN, SKY, VERMILION
from viewer.widgets import faded

FRUSTUM_DEPTH = 0.12  # of the scene's radius: visible beside the scene, not in its way
SHADE = ImVec4(0.0, 0.0, 0.0, 0.6)  # under bright lines and words, so that they read on any picture


class ViewportPanel:
    def __init__(self, context: moderngl.Context, renderer: ImguiRenderer) -> None:
        self._picture = ViewportPicture(context)
        self._renderer = renderer
        self.input = ViewportInput()
        self.stale = False
        self._named: moderngl.Texture | None = None  # what the renderer knows of the picture

    def draw(self, ui: PanelUi, state: AppState, alone: bool) -> None:
        """`alone`: it fills what the bars leave of the window."""
        imgui.push_style_var(imgui.StyleVar_.window_padding, ImVec2(0, 0))
        imgui.push_style_var(imgui.StyleVar_.window_border_size, 0.0)  # it would cover the picture's outermost pixels
        imgui.push_style_color(imgui.Col_.window_bg, ui.theme.ground)
        flags = imgui.WindowFlags_.no_scrollbar | imgui.WindowFlags_.no_scroll_with_mouse
        if state.snapshot.preview is not None:  # it covers the window
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
        imgui.begin(f"{VIEWPORT}##alone" if alone else VIEWPORT, None, flags)
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
        self._draw_picture(draw, state, camera, origin)
        imgui.set_cursor_screen_pos(origin)
        buttons = imgui.ButtonFlags_
        every = buttons.mouse_button_left | buttons.mouse_button_right | buttons.mouse_button_middle
        imgui.invisible_button("canvas", ImVec2(width, height), every)
        ui.mark("viewport")
        self.input.pointer(state, (origin.x, origin.y), imgui.is_item_active(), imgui.is_item_hovered(), ui.em)
        scene = state.snapshot.scene
        if scene is not None:
            self._draw_space(
                ui, state, scene, Overlay(draw, camera, (origin.x, origin.y), NEAR * state.camera.distance)
            )
        self._draw_words(ui, state, draw, origin, ImVec2(width, height))

    def _draw_picture(self, draw: imgui.ImDrawList, state: AppState, camera: Camera, origin: ImVec2) -> None:
        snapshot = state.snapshot
        preview, scene = snapshot.preview, snapshot.scene
        self.stale = False
        if preview is None or scene is None:
            return
        self.stale = self._picture.draw(preview, camera, scene.background)
        far = ImVec2(origin.x + camera.width, origin.y + camera.height)
        texture, first, last = self._picture.shown
        if self._named is not None and self._named is not texture:
            self._renderer.remove(self._named)
        self._named = texture
        draw.add_image(self._renderer.add(texture, opaque=True), origin, far, ImVec2(*first), ImVec2(*last))

    def _draw_space(self, ui: PanelUi, state: AppState, scene: Scene, overlay: Overlay) -> None:
        theme, thin = ui.theme, max(1.0, ui.em / 14)
        if state.show_cameras:
            train = set(scene.split("train"))
            depth = FRUSTUM_DEPTH * scene.radius
            for indices, color in ((train, theme.text), (set(range(len(scene.views))) - train, theme.muted)):
                cameras = [scene.views[k].camera for k in sorted(indices)]
                if cameras:
                    overlay.lines(*frusta(cameras, depth), faded(SHADE, 0.5), 2.5 * thin)  # for a white ground
                    overlay.lines(*frusta(cameras, depth), ImVec4(color.x, color.y, color.z, 0.55), thin)
        ray = state.snapshot.ray
        if not state.show_samples or ray is None:
            return
        start = ray.origin + ray.near * ray.direction
        end = ray.origin + ray.far * ray.direction
        overlay.lines(start[None], end[None], SHADE, 3 * thin)
        overlay.lines(start[None], end[None], theme.ray, 1.2 * thin)
        if ray.passes:
            overlay.samples(ray, ui.em, theme.ground)
        radiance = state.snapshot.radiance
        if radiance is not None:
            overlay.point(radiance.point, 1.15 * ui.em, SHADE)
            overlay.point(radiance.point, ui.em, theme.point)

    def _draw_words(self, ui: PanelUi, state: AppState, draw: imgui.ImDrawList, origin: ImVec2, size: ImVec2) -> None:
        snapshot = state.snapshot
        if snapshot.preview is None:
            _centred(ui, draw, origin, size, _why_empty(state))
            return
        words = []
        if self.stale:
            words.append(f"{icons.ICON_FA_CLOCK}  stale: the last picture, warped")
        if snapshot.preview.quality == "coarse" and snapshot.coarse:
            words.append(snapshot.coarse)
        if snapshot.stage:
            words.append(snapshot.stage)
        if words:
            _chip(ui, draw, ImVec2(origin.x + 0.6 * ui.em, origin.y + size.y - 2.2 * ui.em), "  ·  ".join(words))
        if state.show_cameras and snapshot.scene is not None:
            place = ImVec2(origin.x + size.x - 3 * ui.em, origin.y + size.y - 3 * ui.em)
            _axes(ui, draw, place, state.camera.camera(int(size.x), int(size.y)), snapshot.scene.up)

    def release(self) -> None:
        self._picture.release()


def _why_empty(state: AppState) -> tuple[str, str]:
    """A line, and a quieter one under it."""
    snapshot = state.snapshot
    match snapshot.status:
        case "loading":
            return "Opening", snapshot.loading
        case "failed":
            return "No picture: the worker failed", "see Notices"
        case "empty":
            return "Nothing is open", "Ctrl+O opens a folder of posed photos"
        case _:
            return "The first picture is on its way", ""


def _centred(ui: PanelUi, draw: imgui.ImDrawList, origin: ImVec2, size: ImVec2, lines: tuple[str, str]) -> None:
    y = origin.y + 0.5 * size.y - ui.em
    for line, color in zip(lines, (ui.theme.text, ui.theme.muted), strict=True):
        width = imgui.calc_text_size(line).x
        x = origin.x + max(0.5 * (size.x - width), 0.5 * ui.em)
        draw.add_text(ImVec2(int(x), int(y)), imgui.color_convert_float4_to_u32(color), line)
        y += 1.5 * ui.em


def _chip(ui: PanelUi, draw: imgui.ImDrawList, place: ImVec2, words: str) -> None:
    """Words on a dark ground of their own."""
    size = imgui.calc_text_size(words)
    pad = 0.45 * ui.em
    far = ImVec2(place.x + size.x + 2 * pad, place.y + size.y + pad)
    draw.add_rect_filled(place, far, imgui.color_convert_float4_to_u32(SHADE), 0.2 * ui.em)
    at = ImVec2(int(place.x + pad), int(place.y + 0.5 * pad))
    draw.add_text(at, imgui.color_convert_float4_to_u32(ui.theme.text), words)


def _axes(ui: PanelUi, draw: imgui.ImDrawList, centre: ImVec2, camera: Camera, up: np.ndarray) -> None:
    """World x, y, z; the ones that point away first, under the others."""
    named = zip(axis_directions(camera, up), "xyz", (VERMILION, GREEN, SKY), strict=True)
    for (direction, towards, is_up), name, color in sorted(named, key=lambda item: item[0][1]):
        strong = imgui.color_convert_float4_to_u32(ImVec4(color.x, color.y, color.z, 1.0 if towards > -0.2 else 0.5))
        tip = ImVec2(centre.x + 1.6 * ui.em * direction[0], centre.y + 1.6 * ui.em * direction[1])
        draw.add_line(centre, tip, strong, max(1.0, ui.em / (6 if is_up else 10)))
        size = imgui.calc_text_size(name)
        out = ImVec2(centre.x + 2.2 * ui.em * direction[0], centre.y + 2.2 * ui.em * direction[1])
        draw.add_text(ImVec2(out.x - size.x / 2, out.y - size.y / 2), strong, name)
