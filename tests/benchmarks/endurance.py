"""Let a random user loose on the window while the model trains, open scenes again and again, and watch the memory.

    xvfb-run -s '-screen 0 1600x1000x24' python tests/benchmarks/endurance.py

Half an hour of training, 5,000 random events (moves, clicks, drags, wheel, keys, text) anywhere in the window, and 50
scenes opened one after the other: the demo scene, or the captures that are given. A line for each scene says what the
process held just before the next one was opened. At the end, the mean of the last quarter is compared with that of the
second one; the first quarter fills caches. The status is 1 if it is more than SLACK larger, or if the worker failed.
"""

from __future__ import annotations

import argparse
import gc
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

SLACK = 0.05  # of the memory held
KEYS = ("space", "tab", "escape", "enter", "home", "end", "left_arrow", "right_arrow", "up_arrow", "delete")
KEYS += (*"wasdqefhrp", "_1", "_2", "_3")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="*", type=Path, help="folders to open in turn; none: the demo scene")
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--events", type=int, default=5000)
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--offscreen", action="store_true", help="draw through EGL instead of in a window")
    args = parser.parse_args()
    captures: list[Path | None] = [path.resolve() for path in args.captures] or [None]
    with tempfile.TemporaryDirectory() as home:
        live_in(home)
        return _run(args, captures)


def live_in(home: str) -> None:
    """Make a folder the place of all that the random user saves and clears, and of all autosaves."""
    os.chdir(home)
    for name in ("HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "TMPDIR"):
        if name != "XDG_CACHE_HOME" or name not in os.environ:
            os.environ[name] = home
    tempfile.tempdir = home  # it is known already, so that TMPDIR alone would change nothing in this process


def _run(args: argparse.Namespace, captures: list[Path | None]) -> int:
    from imgui_bundle import imgui

    from nerf_core.datasets import LoadOptions
    from nerf_core.live.messages import OpenScene
    from nerf_core.live.worker import Worker
    from nerf_core.training.settings import RunSettings
    from viewer.app.app import App

    if args.offscreen:
        from viewer.window.egl_window import EglWindow

        window = EglWindow((1280, 800))
    else:
        from viewer.window.glfw_window import GlfwWindow

        window = GlfwWindow("endurance", (1280, 800))
    chance, faults = random.Random(args.seed), list[str]()
    worker = Worker(RunSettings(), wake=window.wake)
    worker.start()
    app = App(window, worker)
    held: list[float] = []
    done, period = 0, 60 * args.minutes / args.scenes
    begin = time.monotonic()
    print("scene  minutes  events  steps     MB  objects")
    for scene in range(args.scenes):
        settings = RunSettings(load=LoadOptions(downscale=chance.choice([2, 4])))
        worker.send(OpenScene(captures[scene % len(captures)], settings, train=True))
        steps = 0
        while time.monotonic() - begin < (scene + 1) * period:
            due = int(args.events * (time.monotonic() - begin) / (60 * args.minutes))
            while done < due:
                done += 1
                _event(app, imgui, chance)
            end = time.monotonic() + 0.02
            app.run(lambda end=end: time.monotonic() > end)
            steps = max(steps, app.state.snapshot.step)
            told = [shown.notice.text for shown in app.state.notices]
            faults += [text for text in told if "worker failed" in text and text not in faults]
        gc.collect()
        held.append(_megabytes())
        objects = len(gc.get_objects())
        spent = (time.monotonic() - begin) / 60
        print(f"{scene + 1:5}  {spent:7.1f}  {done:6,}  {steps:5,}  {held[-1]:5,.0f}  {objects:7,}", flush=True)
    alive = worker.alive
    worker.stop()
    app.close()
    window.close()
    quarter = max(len(held) // 4, 1)
    before, after = (sum(part) / len(part) for part in (held[quarter : 2 * quarter], held[-quarter:]))
    print(f"{done:,} events, {len(held)} scenes: {before:,.0f} MB in the second quarter, {after:,.0f} MB in the last")
    for fault in faults[:5]:
        print(fault)
    return int(not alive or bool(faults) or after > (1 + SLACK) * before)


def _event(app: Any, imgui: Any, chance: random.Random) -> None:
    """One random thing that a user might do."""
    width, height = app.window.size()
    x, y = chance.random() * width, chance.random() * height
    user = app.injector
    match chance.randrange(7):
        case 0:
            user.move(x, y)
        case 1 | 2:
            user.click(x, y, chance.choice([0, 0, 0, 1]))
        case 3:
            start = width * chance.uniform(0.05, 0.7), height * chance.uniform(0.1, 0.5)
            user.drag(start, (x, y), chance.choice([0, 0, 1, 2]), shift=chance.random() < 0.2)
        case 4:
            user.wheel(x, y, chance.choice([-3, -1, 1, 3]))
        case 5:
            user.key(getattr(imgui.Key, chance.choice(KEYS)), ctrl=chance.random() < 0.1)
        case _:
            user.type_text(chance.choice(["0.5", "a.png", "../x", "ü €", "run.safetensors", "9" * 40]))


def _megabytes() -> float:
    """The process's resident memory (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    sys.exit(main())
