"""Run command lines one after the other in each of the processes that torchrun started, with trouble on the way.

    torchrun --standalone --nproc_per_node 2 -m several FOLDER

FOLDER/scenarios.json holds a list of `Scenario`s as objects. NAME.RANK.json receives an `Outcome` of each.
"""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from nerf_core.cli import main
from nerf_core.common.errors import UserError
from nerf_core.training import loop
from nerf_core.training.trainer import Report, Trainer, nothing

SHORT_PATIENCE = 4.0  # seconds


@dataclass(frozen=True)
class Scenario:
    """A command line, and what happens to the second process before it makes step `step`: a key of TROUBLES."""

    name: str
    arguments: list[str] = field(default_factory=list)
    trouble: str = ""
    step: int = 0


@dataclass(frozen=True)
class Outcome:
    """The exit status and what was printed."""

    status: int
    out: str
    err: str


def stopped(trainer: Trainer) -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def failed(trainer: Trainer) -> None:
    raise UserError("no luck")


def parted(trainer: Trainer) -> None:
    with torch.no_grad():
        trainer.method.parameters()[0][0, 0] += 1e-3


def hung(trainer: Trainer) -> None:
    time.sleep(1.5 * SHORT_PATIENCE)


TROUBLES: dict[str, Callable[[Trainer], None]] = {f.__name__: f for f in (stopped, failed, parted, hung)}


def run(scenario: Scenario, rank: int) -> Outcome:
    """Run the command line in this process."""
    from nerf_core.training import distributed

    step, out, err = Trainer.step, io.StringIO(), io.StringIO()

    def troubled(self: Trainer, yield_callback: Callable[[], None] = nothing) -> Report:
        if scenario.trouble and rank == 1 and self.step_count == scenario.step:
            TROUBLES[scenario.trouble](self)
        return step(self, yield_callback)

    distributed.PATIENCE = SHORT_PATIENCE if scenario.trouble == "hung" else 300.0
    Trainer.step = troubled
    try:
        with redirect_stdout(out), redirect_stderr(err):
            status = main(scenario.arguments)
    finally:
        Trainer.step = step
    return Outcome(status, out.getvalue(), err.getvalue())


if __name__ == "__main__":
    folder, rank = Path(sys.argv[1]), int(os.environ["RANK"])
    loop.COMPARE_EVERY = 2
    for values in json.loads((folder / "scenarios.json").read_text(encoding="utf-8")):
        scenario = Scenario(**values)
        text = json.dumps(asdict(run(scenario, rank)))
        (folder / f"{scenario.name}.{rank}.json").write_text(text, encoding="utf-8")
