"""What the window needs of the worker."""

from __future__ import annotations

from typing import Protocol

from nerf_core.live.messages import Command, Notice, Snapshot, ViewRequest


class Link(Protocol):
    """The window's side of `nerf_core.live.worker.Worker`; none of these ever waits."""

    def send(self, command: Command) -> int:
        """Queue a command; notices that answer it carry this number."""
        ...

    def request_view(self, request: ViewRequest) -> None: ...

    def snapshot(self) -> Snapshot: ...

    def notices(self) -> list[Notice]: ...

    def painted(self, seconds: float) -> None:
        """The window drew a frame, which took so long."""
        ...
