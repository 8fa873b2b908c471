"""Measure how smoothly the window runs while the model trains, and what that costs the training.

    xvfb-run -s '-screen 0 1600x1000x24' python tests/benchmarks/window.py

A real window shows the demo scene. Each round measures training alone, and then three phases: the window at rest, a
user who orbits all the time, and a user at the microscope. The last pins eight rays, clicks another pixel every second,
and brings other panels to the front every half second. Prints

- for each phase, the frame times (from the start of drawing until the frame is on the screen) and the training speed as
  a share of that alone in the same round,
- for orbiting, the delay from a moved camera until the first newly computed pixels are on the screen (not the warp of
  the old picture),
- for the microscope, the delay from a click until every panel shows the new ray, and the time between two updates of a
  pinned ray,
- the most memory that the process had at any time.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from imgui_bundle import imgui

from nerf_core.live.messages import (
    Command,
    Inspect,
    OpenScene,
    PinRay,
    Snapshot,
    Train,
    UnpinRay,
    ViewRequest,
)  # fmt: skip
from nerf_core.live.worker import Worker
from nerf_core.training.settings import RunSettings
from viewer.app.app import App
from viewer.window import Window

TABS = (  # brought to the front together, one in each of the two docks of the microscope
    ("Ray", "Radiance"), ("Samples", "Evidence"), ("Ray history", "Slice"), ("Follow this pixel", "Radiance"),
)  # fmt: skip
MOUSE = 1 / 125  # seconds between two reports of a mouse
WARM = 600  # steps before measuring begins: a voxel grid then has its final resolution


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="seconds of each phase of a round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--offscreen", action="store_true", help="draw through EGL instead of in a window")
    parser.add_argument("--method", default="auto")
    args = parser.parse_args()
    window = _window(args.offscreen)
    worker = _training(RunSettings(method=args.method), window)
    link = _Stopwatch(worker)
    app = App(window, link)
    print(f"{window.context.info['GL_RENDERER']}, {window.size()[0]}×{window.size()[1]}")
    resting, orbiting, microscope = phases = [
        _Phase("at rest"), _Phase("orbiting all the time", 3), _Phase("under the microscope", clicks=True),
    ]  # fmt: skip
    user = _User(app)

    def turn(phase: _Phase) -> None:
        if phase.clicks:
            user.click()
        if phase.pixels:
            window.poll(MOUSE)
            app.state.camera.orbit(phase.pixels, 0, 500)
            app.frame()
        else:
            end = time.perf_counter() + 0.05
            app.run(lambda: time.perf_counter() > end)  # waits while there is nothing to show

    while not link.frames:
        turn(resting)
    print(f"first frame (layout, fonts, shaders): {link.frames[0]:.0f} ms")
    for _ in range(args.rounds):
        worker.request_view(None)
        alone = _speed(worker, args.seconds, lambda: time.sleep(0.05))
        app.state.camera.orbit(1, 0, 500)  # the window asks for pictures again
        for phase in phases:
            user.pin(8 if phase.clicks else 0)
            work = partial(turn, phase)
            _speed(worker, 2.0, work)  # fills its panels and makes its first previews before measuring
            link.frames.clear()
            link.delays.clear()
            link.opened.clear()
            link.looked.clear()
            phase.kept.append(_speed(worker, args.seconds, work) / alone)
            phase.frames.append(tuple(link.frames))
            phase.delays += link.delays
            phase.opened += link.opened
            phase.looked += link.looked
    for phase in phases:
        _report(phase)
    _print_times("moved camera to new pixels", orbiting.delays)
    _print_times("click to the new ray in every panel", microscope.opened)
    _print_times("between two looks at a pinned ray", microscope.looked)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)
    print(f"peak memory at step {worker.snapshot().step:,}: {peak:.2f} GiB")
    worker.stop()
    app.close()
    window.close()


def _window(offscreen: bool) -> Window:
    if offscreen:
        from viewer.window.egl_window import EglWindow

        return EglWindow((1280, 800))
    from viewer.window.glfw_window import GlfwWindow

    return GlfwWindow("benchmark", (1280, 800))


def _training(settings: RunSettings, window: Window) -> Worker:
    """Start a worker that trains on the demo scene, and wait for its first WARM steps."""
    worker = Worker(settings, wake=window.wake)
    worker.start()
    worker.send(OpenScene(None, settings))
    worker.send(Train())
    while worker.snapshot().step < WARM:
        time.sleep(0.05)
    return worker


@dataclass
class _Phase:
    """pixels: how far the user drags the camera in each turn. clicks: whether the user opens ray after ray."""

    name: str
    pixels: int = 0
    clicks: bool = False
    kept: list[float] = field(default_factory=list)
    frames: list[tuple[float, ...]] = field(default_factory=list)  # of each round
    delays: list[float] = field(default_factory=list)
    opened: list[float] = field(default_factory=list)
    looked: list[float] = field(default_factory=list)


def _report(phase: _Phase) -> None:
    low, middle, high = min(phase.kept), statistics.median(phase.kept), max(phase.kept)
    print(f"{phase.name}: training keeps {middle:.0%} ({low:.0%} – {high:.0%}) of its speed alone, asked for 60%")
    _print_times("frame", [one for frames in phase.frames for one in frames])
    rounds = [float(np.percentile(frames, 99)) for frames in phase.frames if frames]
    print(f"  p99 of a round's frames: {statistics.median(rounds):.0f} ({min(rounds):.0f} – {max(rounds):.0f}) ms")


class _User:
    """Opens a random pixel every second, and brings other tabs to the front twice a second."""

    def __init__(self, app: App) -> None:
        self._app, self._rng = app, np.random.default_rng(0)
        self._clicked = self._turned = 0.0
        self._stack = 0

    def _ray(self) -> Inspect:
        column, row = self._rng.integers((200, 150), (600, 450)).tolist()
        return Inspect(self._app.state.camera.camera(800, 600), (column, row))

    def pin(self, count: int) -> None:
        for pin in tuple(self._app.state.snapshot.pins):
            self._app.perform(UnpinRay(pin.id))
        for _ in range(count):
            self._app.perform(PinRay.of(self._ray()))

    def click(self) -> None:
        now = time.perf_counter()
        if now - self._clicked > 1:
            self._clicked = now
            self._app.perform(self._ray())
        if now - self._turned > 0.5:
            self._turned = now
            for title in TABS[self._stack % len(TABS)]:
                imgui.set_window_focus(title)
            self._stack += 1


def _speed(worker: Worker, seconds: float, work: Callable[[], None]) -> float:
    """Return the training steps per second of wall time while `work` is called again and again."""
    begin, step = time.perf_counter(), worker.snapshot().step
    while time.perf_counter() - begin < seconds:
        work()
    return (worker.snapshot().step - step) / (time.perf_counter() - begin)


def _print_times(name: str, milliseconds: list[float]) -> None:
    if not milliseconds:
        print(f"  {name}: never")
        return
    p = np.percentile(milliseconds, [50, 95, 99, 100])
    print(f"  {name}: {len(milliseconds)} times, p50 {p[0]:.1f}, p95 {p[1]:.1f}, p99 {p[2]:.1f}, max {p[3]:.1f} ms")


class _Stopwatch:
    """A worker that records how long frames take, and how long requests wait until their result is on the screen."""

    def __init__(self, worker: Worker) -> None:
        self._worker = worker
        self.frames: list[float] = []  # milliseconds
        self.delays: list[float] = []
        self.opened: list[float] = []
        self.looked: list[float] = []
        self._clicked: tuple[Inspect, float] | None = None
        self._pins: dict[int, tuple[int, float]] = {}  # by pin: the step of its newest ray, and when that ray came
        self._asked: dict[int, float] = {}
        self._read = worker.snapshot()
        self.notices = worker.notices

    def send(self, command: Command) -> int:
        if isinstance(command, Inspect):
            self._clicked = command, time.perf_counter()
        return self._worker.send(command)

    def request_view(self, request: ViewRequest | None) -> None:
        if request is not None:
            self._asked[request.stamp] = time.perf_counter()
        self._worker.request_view(request)

    def snapshot(self) -> Snapshot:
        self._read = self._worker.snapshot()
        return self._read

    def paints(self) -> None:
        self._worker.paints()

    def painted(self, seconds: float) -> None:
        """Record that a frame with the snapshot read last is on the screen."""
        self._worker.painted(seconds)
        self.frames.append(1e3 * seconds)
        snapshot = self._read
        if snapshot.preview is not None and snapshot.preview.stamp in self._asked:
            answered = snapshot.preview.stamp
            self.delays.append((time.perf_counter() - self._asked[answered]) * 1e3)
            self._asked = {stamp: t for stamp, t in self._asked.items() if stamp > answered}
        now = time.perf_counter()
        if self._clicked is not None:
            command, asked = self._clicked
            if snapshot.opened_look == command.look:
                self.opened.append((now - asked) * 1e3)
                self._clicked = None
        for pin in snapshot.pins:
            if pin.ray is None:
                continue
            step, before = self._pins.get(pin.id, (-1, now))
            if pin.ray.step != step:
                if step >= 0:
                    self.looked.append((now - before) * 1e3)
                self._pins[pin.id] = pin.ray.step, now


if __name__ == "__main__":
    main()
