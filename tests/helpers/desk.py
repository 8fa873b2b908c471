"""What a window does with a worker: sends, waits, and reads what comes back."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from nerf_core.geometry.camera import Camera
from nerf_core.geometry.scene import Scene
from nerf_core.live.messages import Command, Notice, OpenScene, Snapshot, Train, ViewRequest
from nerf_core.live.worker import Worker
from nerf_core.training.settings import RunSettings

PATIENCE = 300.0  # seconds: what takes some on an old laptop is waited for on a machine ten times as slow
AFTER_FAILURE = 30.0  # seconds: a worker that failed unexpectedly seldom does what the test waits for


class Desk:
    """A started worker; `heard` collects its notices. With a capture, its scene is open at once."""

    def __init__(self, settings: RunSettings, capture: Path | None) -> None:
        self.worker = Worker(settings)
        self.settings, self.heard = settings, list[Notice]()
        self.worker.start()
        if capture is not None:
            self.send(OpenScene(capture, settings))
            self.until(lambda s: s.status == "ready")

    def send(self, *commands: Command) -> list[int]:
        return [self.worker.send(command) for command in commands]

    def until(self, wanted: Callable[[Snapshot], bool]) -> Snapshot:
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            notices = self.worker.notices()
            self.heard += notices
            if any(notice.text.startswith("the worker failed") for notice in notices):
                end = min(end, time.monotonic() + AFTER_FAILURE)
            snapshot = self.worker.snapshot()
            if wanted(snapshot):
                return snapshot
            time.sleep(0.005)
        raise AssertionError(f"in vain; {self.worker.snapshot()}, {self.heard}")

    def until_told(self, text: str) -> Notice:
        self.until(lambda _: any(text in notice.text for notice in self.heard))
        return next(notice for notice in self.heard if text in notice.text)

    def until_answered(self, number: int) -> Notice:
        """The first notice that answers a command."""
        self.until(lambda _: any(notice.command == number for notice in self.heard))
        return next(notice for notice in self.heard if notice.command == number)

    def trained(self, steps: int) -> Snapshot:
        before = self.worker.snapshot().step
        self.send(Train(steps))
        return self.until(lambda s: s.step == before + steps and s.status != "training")


def view_of(scene: Scene | None, stamp: int, moving: bool = False, size: int = 13) -> ViewRequest:
    assert scene is not None
    return ViewRequest(stamp, scene.views[0].camera.resized(size, size), moving)


def orbit(scene: Scene | None, frames: int) -> tuple[Camera, ...]:
    assert scene is not None
    return tuple(scene.views[i % 6].camera for i in range(frames))
