"""Files of the model itself, such as points or a mesh: one file per kind."""

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
    """A kind of file. It is a `Job`: its pieces of work take some 10 ms each, and the last one writes the file.

    suffix: of its files, with the dot, in lower case. label: for menus. summary: a few words for the command line.
    """

    suffix: ClassVar[str]
    label: ClassVar[str]
    summary: ClassVar[str]

    def __call__(self, method: Method, scene: Scene, file: Path) -> Job:
        """The job that writes `file`. Raises UserError if the method lacks what the export needs."""
        ...


EXPORTS: Registry[ModelExport] = Registry("model export", "nerf_core.rendering.export.models")


def export_for(file: Path) -> ModelExport:
    """The kind of export that writes files of this suffix. Raises UserError that lists the suffixes."""
    kinds = [EXPORTS.get(name) for name in EXPORTS.names()]
    for kind in kinds:
        if kind.suffix == file.suffix.lower():
            return kind
    known = " or ".join(kind.suffix for kind in kinds) or "no model file; no model export is installed"
    raise UserError(f"{file}: a model is written as {known}")
