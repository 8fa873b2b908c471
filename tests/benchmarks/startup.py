"""Measure how long a user waits for the window and for the first picture of the demo scene.

    xvfb-run -s '-screen 0 1600x1000x24' python tests/benchmarks/startup.py

Each round is a fresh process. The first warms the disk's cache and is not counted. Prints the median and the spread of
the seconds since the process was started, and for the picture also of those since training began.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time


def child(started: float) -> None:
    """Open the window as the command does. Print the seconds from `started` until each part is there."""
    from nerf_core.common.command_line import parse
    from nerf_core.common.signals import Signals
    from nerf_core.live.messages import OpenScene, Train
    from nerf_core.training.settings import RunSettings
    from viewer.cli import ViewerOptions
    from viewer.window import load_libraries, open_window

    parse(ViewerOptions, "nerf-viewer", [])
    load_libraries()
    import viewer.session.session as sessions

    with Signals() as signals:
        window = open_window("startup", (1280, 800))
        session = sessions.Session(window, RunSettings(), signals, print)
        session.worker.send(OpenScene(None, RunSettings()))
        session.worker.send(Train())
        marks: dict[str, float] = {}
        painted = session.worker.painted

        def shown(seconds: float) -> None:
            painted(seconds)
            marks.setdefault("window", time.monotonic())
            if session.app.state.snapshot.preview is not None:
                marks.setdefault("picture", time.monotonic())

        def there() -> bool:
            snapshot = session.worker.snapshot()
            if snapshot.scene is not None:
                marks.setdefault("scene", time.monotonic())
            if snapshot.status == "training":
                marks.setdefault("training", time.monotonic())
            return "picture" in marks

        session.worker.painted = shown
        session.app.run(there)
        session.close()
    print(json.dumps({name: mark - started for name, mark in marks.items()}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--child", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        child(args.child)
        return
    rounds = []
    for _ in range(args.rounds + 1):
        command = [sys.executable, __file__, "--child", str(time.monotonic())]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        marks = json.loads(done.stdout.splitlines()[-1])
        rounds.append(marks | {"picture after training began": marks["picture"] - marks["training"]})
    for name in rounds[0]:
        values = [marks[name] for marks in rounds[1:]]
        print(f"{name}: {statistics.median(values):.2f} s (min {min(values):.2f}, max {max(values):.2f})")


if __name__ == "__main__":
    main()
