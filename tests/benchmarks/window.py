"""How smoothly the window runs while the model trains, and what that costs the training.

    xvfb-run -s '-screen 0 1600x1000x24' python tests/benchmarks/window.py

A real window on the demo scene: training alone; then with the window at rest; then with a hand that orbits all the
time. Prints the distribution of frame times (what one turn of the GUI loop took that drew), the delay from a moved
camera to the first newly computed pixels for it (not the warp of the old picture), and the training's steps/s.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from nerf_core.messages import OpenScene, Snapshot, Train, ViewRequest
from nerf_core.settings import RunSettings
from nerf_core.worker import Worker
from viewer.app import App
from viewer.window import Window

WARM = 600  # steps before the measuring begins: by then a voxel grid is as fine as it becomes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each phase")
    parser.add_argument("--offscreen", action="store_true", help="through EGL instead of a window")
    parser.add_argument("--method", default="auto")
    args = parser.parse_args()
    if args.offscreen:
        from viewer.window.egl_window import EglWindow

        window: Window = EglWindow((1280, 800))
    else:
        from viewer.window.glfw_window import GlfwWindow

        window = GlfwWindow("benchmark", (1280, 800))
    settings = RunSettings(method=args.method)
    worker = Worker(settings, wake=window.wake)
    link = _Stopwatch(worker)
    app = App(window, link)
    worker.start()
    worker.send(OpenScene(None, settings))
    while worker.snapshot().scene is None or worker.snapshot().loading:
        time.sleep(0.05)
    worker.send(Train())
    while worker.snapshot().step < WARM:
        time.sleep(0.05)
    print(f"{window.context.info['GL_RENDERER']}, {window.size()[0]}×{window.size()[1]}")
    alone = _speed(worker, args.seconds, lambda: time.sleep(0.05))
    print(f"training alone: {alone:.1f} steps/s")
    frames: list[float] = []

    def turn() -> None:
        window.poll(0.005)
        begin = time.perf_counter()
        if app.frame():
            frames.append((time.perf_counter() - begin) * 1e3)

    def hand() -> None:
        app.state.camera.orbit(3, 0, 500)
        turn()

    begin = time.perf_counter()
    turn()
    print(f"first frame (layout, fonts, shaders): {(time.perf_counter() - begin) * 1e3:.0f} ms")
    _speed(worker, 2.0, turn)  # its panels are filled and its first previews there before the measuring begins
    for label, work in (("window at rest", turn), ("orbiting all the time", hand)):
        frames.clear()
        link.delays.clear()
        speed = _speed(worker, args.seconds, work)
        print(f"{label}: {speed:.1f} steps/s, {speed / alone:.0%} of training alone")
        _tell("frame", frames)
        if work is hand:
            _tell("moved camera to new pixels", link.delays)
    worker.stop()
    app.close()
    window.close()


def _speed(worker: Worker, seconds: float, work: Callable[[], None]) -> float:
    """Training steps per second of wall time while `work` is called over and over."""
    begin, step = time.perf_counter(), worker.snapshot().step
    while time.perf_counter() - begin < seconds:
        work()
    return (worker.snapshot().step - step) / (time.perf_counter() - begin)


def _tell(name: str, milliseconds: list[float]) -> None:
    p = np.percentile(milliseconds, [50, 95, 99, 100])
    print(f"  {name}: {len(milliseconds)} times, p50 {p[0]:.1f}, p95 {p[1]:.1f}, p99 {p[2]:.1f}, max {p[3]:.1f} ms")


class _Stopwatch:
    """A worker that notes how long a view waited for its first pixels."""

    def __init__(self, worker: Worker) -> None:
        self._worker = worker
        self.delays: list[float] = []
        self._asked: dict[int, float] = {}
        self.send, self.notices = worker.send, worker.notices

    def request_view(self, request: ViewRequest) -> None:
        self._asked[request.stamp] = time.perf_counter()
        self._worker.request_view(request)

    def snapshot(self) -> Snapshot:
        snapshot = self._worker.snapshot()
        if snapshot.preview is not None and snapshot.preview.stamp in self._asked:
            answered = snapshot.preview.stamp
            self.delays.append((time.perf_counter() - self._asked[answered]) * 1e3)
            self._asked = {stamp: t for stamp, t in self._asked.items() if stamp > answered}
        return snapshot


if __name__ == "__main__":
    main()
