"""Make the job of an export request."""

from __future__ import annotations

from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method
from nerf_core.rendering.export.film import FilmJob
from nerf_core.rendering.export.jobs import Job
from nerf_core.rendering.export.models import export_for
from nerf_core.rendering.export.requests import ExportModel, ExportPath, ExportRequest
from nerf_core.rendering.export.still import StillJob


def export_job(request: ExportRequest, method: Method, scene: Scene) -> Job:
    """Make the job that does a request.

    Args:
        request: what to write.
        method: the model; it must not be trained meanwhile. Pass `method.frozen()` if it is.
        scene: its scene.

    Returns:
        A job; call `advance` until it returns False.

    Raises:
        UserError: the suffix of the file is not known, or the file cannot be written.
    """
    if isinstance(request, ExportPath):
        return FilmJob(method, scene, request)
    if isinstance(request, ExportModel):
        return export_for(request.file)(method, scene, request.file)
    return StillJob(method, scene, request)
