"""The window's loop: read the newest snapshot, run the panels, send commands, draw."""

from __future__ import annotations

import time as clock
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from imgui_bundle import ImVec2, imgui, implot

from nerf_core.captures.records import PLACED
from nerf_core.common.errors import UserError
from nerf_core.common.language import ENGLISH, language, phrase, use_language
from nerf_core.common.names import printable
from nerf_core.live.messages import Notice, Snapshot
from nerf_core.rendering.modes import COLOR, MODES, obstacle
from nerf_core.rendering.video import write_png

from ..commands.keyboard import Keyboard
from ..commands.perform import Actions
from ..draw.imgui_renderer import ImguiRenderer
from ..draw.textures import TextureCache
from ..model.left_off import LeftOff
from ..model.link import Link
from ..model.state import Action, AppState
from ..tour.guide import Guide
from ..tour.side_bar import SideBar
from ..ui.contract import Panel
from ..ui.layout import Layout
from ..ui.theme import DarkTheme
from ..window import Window
from . import bars
from .inject import InputInjector
from .pacing import Pacer
from .panel_host import PanelHost, PanelUi, Rect
from .view_requests import ViewRequests
from .viewport_panel import ViewportPanel

PRESENTED = 1.4  # by which type is larger in a lecture hall
SHORTEST = 1e-4  # seconds: imgui needs time to pass between frames, even if the clock stands still


class App:
    """The user interface, on any window. Close it before the window.

    layout_file: the file that remembers the docks; None (headless, tests): nothing is read or written.
    language: the code of the window's language; empty: the one that was chosen last in it, else English.
    panels: the panels; None: all that are registered.
    time: a monotonic clock in seconds.
    """

    def __init__(
        self,
        window: Window,
        link: Link,
        *,
        layout_file: Path | None = None,
        language: str = "",
        panels: Sequence[Panel] | None = None,
        time: Callable[[], float] = clock.monotonic,
    ) -> None:
        self.window = window
        self.link = link
        self._time = time
        self.state = AppState(has_display=window.has_display, time=time(), left_off=LeftOff(window.wake))
        self._context = imgui.create_context()
        imgui.set_current_context(self._context)  # creating a context does not make it current if there is an older one
        implot.create_context()
        self._connect_clipboard()
        io = imgui.get_io()
        io.config_flags |= imgui.ConfigFlags_.docking_enable
        io.config_error_recovery_enable_tooltip = (
            False  # a panel's error becomes a notice and a line in the log instead
        )
        io.config_windows_move_from_title_bar_only = True  # dragging in a plot must not move its panel
        self.theme = DarkTheme()
        self.theme.load_fonts()
        self._scale = 0.0
        self._size = window.size()  # asked once for each frame: that can take milliseconds
        self._renderer = ImguiRenderer(window.context)
        self._textures = TextureCache(self._renderer)
        self._viewport = ViewportPanel(window.context, self._renderer)
        self._ui = PanelUi(self.theme, self._textures)
        self._host = PanelHost(panels)
        self._keyboard = Keyboard()
        self._layout = Layout(layout_file)
        self._pacer = Pacer(watched=window.has_display)
        self._actions = Actions(self.state, link)
        self._views = ViewRequests(link)
        self._tour = SideBar(
            Guide(layout_file.with_name("tour.json") if layout_file is not None else None, window.wake)
        )
        self._answered = 0  # the newest request to open a ray that has been answered
        self._drawn_at = self.state.time
        self._frame_times: deque[float] = deque(maxlen=120)
        self._closed = False
        self._hidden = self._partial = False  # whether no panel was shown in the last frame; whether not all were
        self._front: tuple[str, ...] = ()  # what was in front when all panels were shown
        self._fronts: tuple[str, ...] = ()  # what was in front two frames ago
        self._warn(self._layout.load())
        self.state.language = language or self._layout.language or ENGLISH
        use_language(self.state.language)
        self.injector = InputInjector(lambda: self.frame(force=True))

    # ---- the loop ---------------------------------------------------------------------------------------------

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Run until the window is closed or `until()` is true."""
        while not (self.window.should_close() or until()):
            input_came = self.window.poll(self._pacer.wait(self._time()))
            self._pacer.note(self._time(), user=input_came)
            self.frame()
        self._warn(self._layout.save_if_changed())

    def frame(self, force: bool = False) -> bool:
        """Make one turn of the loop. Returns whether it drew. force: draw although nothing changed."""
        before, self.state.time = self.state.time, self._time()
        now = self.state.time
        self._read()
        if any(before < shown.ends <= now for shown in self.state.notices):
            self._pacer.note(now, figures=True)  # a toast ends
        moved = self.state.camera.update(now)
        self._pacer.note(now, user=moved or force)
        drew = False
        due = force or self._pacer.due(now)
        if due:
            self._size = self.window.size()
        if due and min(self._size) > 0:
            begin = clock.perf_counter()
            self.link.paints()
            self._draw(now)
            self._show()
            seconds = clock.perf_counter() - begin
            self.link.painted(seconds)
            self._pacer.drew(now, seconds, self._frames_part())
            drew = True
            moved = self.state.camera.update(now)  # by the user's input in this frame
            self._pacer.note(now, user=moved, fading=self._viewport.fading)
        if min(self._size) > 0:
            self._refuse_mode()
            self._views.update(self.state, now)
        return drew

    def _refuse_mode(self) -> None:
        """Show colours, and say why, if the method cannot draw the chosen mode: the viewport would stay empty."""
        why = obstacle(self.state.snapshot.method, self.state.mode)
        if why:
            label, self.state.mode = MODES.get(self.state.mode).label, COLOR
            words = phrase("{why}: it cannot show {mode}", why=why, mode=phrase(label.lower()))
            self._actions.tell(Notice("error", words))
            self._pacer.note(self.state.time, user=True)

    def _read(self) -> None:
        """Take the worker's notices, then its snapshot: the state that a notice speaks of is then already there."""
        notices = self.link.notices()
        old, new = self.state.snapshot, self.link.snapshot()
        if new is not old:
            self.state.snapshot = new
            picture = new.preview is not old.preview or _opened(new) != _opened(old)
            self._pacer.note(self.state.time, answer=self._is_answer(new), picture=picture, figures=True)
            if new.posing is not None and old.posing is None:
                self.state.raise_panel = "Capture"
            elif new.posing is None and old.posing is not None:
                self.state.raise_panel = "Scene"
                self.state.searched = None if old.posing.stage == PLACED else replace(old.posing, growing=None)
            elif new.status == "loading" != old.status:
                self.state.searched, self.state.not_opened = None, ""
            if new.loaded != old.loaded and new.scene is not None:
                self.state.camera.set_scene(new.scene)
                self.state.inspect = self.state.current_view = None
                self.state.checkpoint_file = self.state.not_opened = ""
                self.state.searched, self.state.show_left_off = None, False
                for shown in self.state.notices:  # what went wrong with another scene is over
                    shown.dismissed |= shown.notice.level == "error"
        self._focus_behind()
        for notice in notices:
            self._actions.hear(notice)
        for notice in self.state.left_off.notices():
            self._actions.tell(notice)
        if self.state.left_off.changed():
            self._pacer.note(self.state.time, user=True)
        if notices:
            self._pacer.note(self.state.time, user=True)

    def _is_answer(self, snapshot: Snapshot) -> bool:
        """Whether this snapshot is the first that has all of the requested ray."""
        asked = self.state.inspect
        if asked is None or asked.look == self._answered or snapshot.opened_look != asked.look:
            return False
        self._answered = asked.look
        return True

    def _focus_behind(self) -> None:
        """Focus on the surface that the verdict names, as soon as a double click's ray has one.

        That surface lies behind a floater, and not between two surfaces like the picture's mean depth.
        """
        state, opened = self.state, self.state.snapshot.opened
        if state.focus is None or opened is None or opened.verdict is None:
            return
        if state.snapshot.opened_id != state.focus.id:
            return
        stood, state.focus = state.focus.camera.c2w[:, 3], None
        if opened.verdict.surface_t is not None and np.allclose(state.camera.c2w()[:, 3], stood):  # else they went on
            state.camera.focus(opened.ray.origin + opened.verdict.surface_t * opened.ray.direction)

    # ---- drawing ----------------------------------------------------------------------------------------------

    def _draw(self, now: float) -> None:
        scale = self.window.scale() * (PRESENTED if self.state.presenter else 1.0)
        if scale != self._scale:
            self._scale = scale
            self.theme.apply(scale, strong=self.state.presenter)
            self._layout.fit(self.theme.em, self._size)
        io = imgui.get_io()
        io.display_size = ImVec2(*self._size)
        io.delta_time = max(now - self._drawn_at, SHORTEST)
        self._drawn_at = now
        self._count_frame(now)
        self._textures.begin_frame()
        self._ui.widgets.clear()
        imgui.new_frame()
        actions = self._draw_interface()
        imgui.render()
        surface = self.theme.surface  # docked panels paint no background
        ground = surface.x, surface.y, surface.z, 1.0
        self._renderer.render(imgui.get_draw_data(), self.window.framebuffer, ground, self.window.keeps)
        for action in actions:
            self._actions.perform(action)
        self._save_screenshots()

    def _frames_part(self) -> float:
        """The share of time for frames: half of what training leaves. The other half is for the worker's pictures."""
        snapshot = self.state.snapshot
        return snapshot.frame_share if snapshot.status == "training" else 1.0

    def _show(self) -> None:
        self.window.swap()
        self.window.set_cursor(imgui.get_mouse_cursor())
        self._warn(self._layout.save_if_changed())

    def _draw_interface(self) -> list[Action]:
        state, ui, viewport = self.state, self._ui, self._viewport
        if state.language != language():
            self._speak(state.language)
        state.sample, state.pointed_at = state.pointed_at, None
        keyed, flying = self._keyboard.act(state, imgui.get_io().delta_time)
        held = any(imgui.is_mouse_down(button) for button in range(3))
        self._pacer.note(self.state.time, user=flying or held)
        actions = list(bars.draw_menu(ui, state))
        bars.draw_status(ui, state)
        actions += list(self._tour.draw(ui, state))
        self._pacer.note(state.time, user=self._tour.guide.busy)
        page = state.show_panels and bool(state.page)
        docks = state.show_panels and not page
        if page:
            state.in_front = (state.page,)
        elif not self._layout.raising and self._host.in_front == self._fronts:  # tabs that come forward take two frames
            state.in_front = self._host.in_front
        self._fronts = () if self._layout.raising else self._host.in_front
        self._wishes()
        if docks:
            self._layout.dock(self._host.panels, ui.em, self._front)
        if page:
            actions += self._host.draw_page(ui, state)
        else:
            viewport.draw(ui, state, alone=not docks)
        whole = docks and state.only_panels is None
        if docks:
            front = self._host.in_front
            actions += self._host.draw(ui, state)
            if whole and self._partial:
                self._layout.bring_forward(self._front)
            elif whole:
                self._front = front
        self._hidden, self._partial = not docks, not whole
        actions += self._host.draw_overlays(ui, state)
        for notice in self._host.notices:
            self._actions.tell(notice)
        self._host.notices.clear()
        return actions + keyed + viewport.input.take()

    def _save_screenshots(self) -> None:
        """Write the screenshots requested in this frame while the frame is still in the back buffer."""
        paths, self._actions.screenshots = self._actions.screenshots, []
        for path in paths:
            try:
                write_png(path, self.window.read_pixels())
            except UserError as error:
                self._actions.tell(Notice("error", str(error)))
            else:
                self._actions.tell(Notice("info", phrase("saved a screenshot to {path}", path=printable(path)), path))

    def _wishes(self) -> None:
        """Do what commands and panels ask of the window itself."""
        state = self.state
        if state.raise_panel and not (
            self._hidden or self._layout.raising
        ):  # the tabs that come forward first would cover it
            imgui.set_window_focus(state.raise_panel)
            state.raise_panel = ""
        if state.reset_layout:
            self._layout.reset()
        if state.quit:
            self.window.request_close()
        state.reset_layout = state.quit = False

    def _speak(self, code: str) -> None:
        """Show another language, which the user has chosen, and remember it."""
        use_language(code)
        self._layout.language = code
        self._warn(self._layout.save())

    def _count_frame(self, now: float) -> None:
        """Count the frames of the last second."""
        self._frame_times.append(now)
        while now - self._frame_times[0] > 1:
            self._frame_times.popleft()
        self.state.frames_per_second = float(len(self._frame_times))

    # ---- for scripts, tests and the headless mode ---------------------------------------------------------------

    @property
    def widgets(self) -> dict[str, Rect]:
        """Return the rectangles of the marked widgets visible in the last frame; "viewport" is the picture."""
        return dict(self._ui.widgets)

    @property
    def tour(self) -> Guide:
        return self._tour.guide

    @property
    def stale(self) -> bool:
        """Return whether the last frame showed anything of an older picture."""
        return self._viewport.stale or self._viewport.fading

    def perform(self, action: Action) -> int:
        """Do an action as if a panel had returned it. Returns the number of the command sent to the worker, else 0."""
        return self._actions.perform(action)

    def tell(self, notice: Notice) -> None:
        """Show a notice."""
        self._actions.tell(notice)

    def pixels(self) -> np.ndarray:
        """Draw a frame and read the whole window: uint8 (H, W, 3)."""
        self.frame(force=True)  # handles waiting input
        self._draw(self.state.time)
        pixels = self.window.read_pixels()
        self._show()
        self._pacer.drew(self.state.time)
        return pixels

    def screenshot(self, path: Path) -> None:
        """Write the whole window as a PNG. Raises UserError if that fails."""
        write_png(path, self.pixels())

    def settle(self, frames: int = 3) -> None:
        """Draw frames until imgui has processed input and layout."""
        for _ in range(frames):
            self.frame(force=True)

    # ---- beginning and end --------------------------------------------------------------------------------------

    def _connect_clipboard(self) -> None:
        platform = imgui.get_platform_io()
        platform.platform_get_clipboard_text_fn = lambda _: self.window.clipboard()
        platform.platform_set_clipboard_text_fn = lambda _, text: self.window.set_clipboard(text)

    def _warn(self, text: str | None) -> None:
        if text:
            self._actions.tell(Notice("warning", text))

    def close(self) -> None:
        """Save the layout and free everything but the window. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        use_language(ENGLISH)
        self._layout.save()
        self._viewport.release()
        self._textures.release()
        self._renderer.release()
        implot.destroy_context()
        imgui.destroy_context(self._context)


def _opened(snapshot: Snapshot) -> tuple[object, ...]:
    """A value that changes when something of an opened or pinned ray changes."""
    return id(snapshot.opened), *((pin.id, id(pin.ray), pin.name, pin.hidden) for pin in snapshot.pins)
