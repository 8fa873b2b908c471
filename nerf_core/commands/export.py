"""`nerf-core export`, if any model export is installed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from nerf_core.commands import COMMANDS
from nerf_core.commands.shared import MOVED_HELP, finished, restored
from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.rendering.export.models import EXPORTS, export_for
from nerf_core.training.run_folder import RunFolder

KINDS = ", ".join(f"{EXPORTS.get(name).suffix} ({EXPORTS.get(name).summary})" for name in EXPORTS.names())


@dataclass(frozen=True)
class Export:
    """Write the model of a trained run to a file."""

    order: ClassVar[int] = 5

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR", help="A run folder.")]
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help=f"The file to write: {KINDS}.")]
    data: Annotated[Path | None, tyro.conf.arg(help=MOVED_HELP)] = None
    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""

    def run(self, signals: Signals) -> int:
        kind = export_for(self.file)
        trainer = restored(RunFolder(self.run_folder), self.data, self.device)
        signals.be_polite()
        finished(kind(trainer.method, trainer.scene, self.file), signals, "exporting", kind.label)
        say(f"wrote {self.file}")
        return 0


if EXPORTS.names():
    COMMANDS.register("export")(Export)
