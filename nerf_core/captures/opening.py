"""Open a capture with or without poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from nerf_core.captures.posing import find_poses
from nerf_core.captures.raw_photos import raw_photos
from nerf_core.captures.records import PoseOptions, PoseProgress
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.scene import Scene


def open_capture(
    path: Path | None,
    options: LoadOptions,
    progress: Callable[[str, int, int], None] | None = None,
    posing: Callable[[PoseProgress], None] | None = None,
) -> Scene:
    """Load a capture. The poses of photos that have none are found first, or found again.

    Args:
        path: a folder, a .json file, or a video; None opens the demo scene.
        options: the user's choices.
        progress: called as (what is done, photos done, photos in all); it may raise to cancel.
        posing: called while poses are found; it may raise to cancel. None: `progress` is called.

    Returns:
        The scene. Its notes say which photos could not be placed.

    Raises:
        UserError: names file, field and remedy.
    """
    raw = raw_photos(path) if options.format == "auto" else None
    if raw is None:
        return load_scene(path, options, progress)

    def tell(state: PoseProgress) -> None:
        if posing is not None:
            posing(state)
        elif progress is not None and state.total:
            progress(state.stage, state.done, state.total)

    posed = find_poses(raw, None, PoseOptions(quality=options.poses, lens=options.lens), tell)
    scene = load_scene(posed.folder, options, progress)
    return replace(scene, notes=(*posed.notes, *scene.notes), posed=posed.summary)
