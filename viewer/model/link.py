"""The interface through which the window uses the worker."""

from __future__ import annotations

from typing import Protocol

from nerf_core.live.messages import Command, Notice, Snapshot, ViewRequest


class Link(Protocol):
    """The window's side of `nerf_core.live.worker.Worker`. No call ever waits."""

    def send(self, command: Command) -> int:
        """Queue a command. Notices that answer it carry the number returned."""
        ...

    def request_view(self, request: ViewRequest) -> None: ...

    def snapshot(self) -> Snapshot: ...

    def notices(self) -> list[Notice]: ...

    def paints(self) -> None:
        """Tell the worker that a frame begins."""
        ...

    def painted(self, seconds: float) -> None:
        """Tell the worker how many seconds a frame of the window took."""
        ...
