"""Exports of the model itself, such as points or a mesh. One file per kind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol

from nerf_core.common.errors import UserError
from nerf_core.common.registry import Registry

if TYPE_CHECKING:
    from nerf_core.geometry.scene import Scene
    from nerf_core.methods import Method
    from nerf_core.rendering.export.jobs import Job


class ModelExport(Protocol):
    """A kind of model file. Calling it makes the `Job` that writes one.

    The job's pieces of work take some 10 ms each, and the last one writes the file.

    suffix: the suffix of its files, with the dot, in lower case.
    label: the name in menus.
    summary: a few words for the command line.
    """

    suffix: ClassVar[str]
    label: ClassVar[str]
    summary: ClassVar[str]

    def __call__(self, method: Method, scene: Scene, file: Path) -> Job:
        """Make the job that writes a file.

        Args:
            method: the model; it is not trained meanwhile.
            scene: its scene.
            file: the file to write.

        Raises:
            UserError: the method lacks what the export needs.
        """
        ...


EXPORTS: Registry[ModelExport] = Registry("model export", "nerf_core.rendering.export.models")


def export_for(file: Path) -> ModelExport:
    """Return the kind of export that writes files of this suffix. Raises UserError, which lists the known suffixes."""
    kinds = [EXPORTS.get(name) for name in EXPORTS.names()]
    for kind in kinds:
        if kind.suffix == file.suffix.lower():
            return kind
    known = " or ".join(kind.suffix for kind in kinds) or "no model file; no model export is installed"
    raise UserError(f"{file}: a model is written as {known}")
