"""Tell the worker which picture the viewport needs."""

from __future__ import annotations

from nerf_core.geometry.camera import Camera
from nerf_core.live.messages import ViewRequest

from ..draw.warp import same_view
from ..model.link import Link
from ..model.state import AppState


class ViewRequests:
    """Sends view requests. Each has a stamp, larger than the ones before, and the worker's answer carries it."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._requested: tuple[Camera, bool, int, str] | None = None  # camera, moving, scene, mode
        self._stamp = 0

    def update(self, state: AppState, now: float) -> None:
        """Request a picture if the camera, the mode or the scene changed, or if the camera came to rest."""
        if state.snapshot.scene is None:
            return
        camera, moving = state.camera.camera(*state.viewport), state.camera.moving(now)
        loaded, mode = state.snapshot.loaded, state.mode
        if self._requested is not None:
            last, *others = self._requested
            if same_view(last, camera) and others == [moving, loaded, mode]:
                return
        self._stamp += 1
        self._requested = camera, moving, loaded, mode
        self._link.request_view(ViewRequest(self._stamp, camera, moving, mode))
