"""From a request to the job that does it."""

from __future__ import annotations

from nerf_core.geometry.scene import Scene
from nerf_core.methods import Method
from nerf_core.rendering.export.film import FilmJob
from nerf_core.rendering.export.jobs import Job
from nerf_core.rendering.export.requests import ExportPath, ExportStill
from nerf_core.rendering.export.still import StillJob


def export_job(request: ExportPath | ExportStill, method: Method, scene: Scene) -> Job:
    """The job for `request`. method: it is not trained on meanwhile. Raises UserError for a file that cannot be."""
    if isinstance(request, ExportPath):
        return FilmJob(method, scene, request)
    return StillJob(method, scene, request)
