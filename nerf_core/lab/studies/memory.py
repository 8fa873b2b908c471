"""`nerf-core lab memory`: memory grows with the cube of a grid's side, and quality flattens."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from nerf_core.common.configs import constant
from nerf_core.common.errors import UserError
from nerf_core.common.language import marked, phrase
from nerf_core.common.text import number, size
from nerf_core.lab.figures import memory_plot
from nerf_core.lab.records import Report, Result, Row, Table
from nerf_core.lab.study import STUDIES, Bench, Subject, Work, budget, checked, spelled
from nerf_core.lab.tables import cell, failures
from nerf_core.lab.training import measured, trained
from nerf_core.training.evaluate import select
from nerf_core.training.settings import RunSettings

LEVEL_STEPS = 20  # of the first, coarse level: the largest grid has all its vertices after some 300 steps
VALUES_BYTES = 16  # of a vertex: red, green, blue and opacity, float32 each


@STUDIES.register("memory")
@dataclass(frozen=True)
class Memory:
    """The dense RGBα grid at several sizes: memory, PSNR and time, as a table and a plot."""

    title: ClassVar[str] = marked("Memory of a grid")
    summary: ClassVar[str] = marked(
        "A dense grid's memory grows with the cube of its side, and its pictures gain less and less."
    )
    order: ClassVar[int] = 2
    of_scene: ClassVar[bool] = True

    sides: str = constant("16,32,64,128,256", marked("sides N of the grid, with commas between"))
    budget: str = constant(
        "60s", marked("of each size: training time such as 90s or 10m, or a number such as 200steps")
    )
    views: int = constant(3, marked("held-out views that are measured, evenly spread"), least=1, most=10_000)
    seed: int = constant(0, marked("of everything random"))

    def __post_init__(self) -> None:
        checked(self)
        budget(self.budget)
        self._sides()

    def _sides(self) -> tuple[int, ...]:
        try:
            found = sorted({int(text) for text in self.sides.split(",")})
        except ValueError:
            found = []
        if not found or not 2 <= found[0] <= found[-1] <= 512:
            raise UserError(f"--sides {self.sides}: give whole numbers from 2 to 512, with commas between")
        return tuple(found)

    def plan(self, subject: Subject) -> tuple[Row, ...]:
        return tuple(Row(f"side-{n}", f"N = {n}", {"side": n}) for n in self._sides())

    def work(self, subject: Subject, row: Row, bench: Bench) -> Work:
        selection = select(subject.capture(), count=self.views)
        side = row.values["side"]
        changes = {"side": str(side), "level_steps": str(LEVEL_STEPS)}
        settings = RunSettings(method="rgba-grid", changes=changes, seed=self.seed)
        trainer = yield from trained(subject, bench, settings, budget(self.budget), selection.views[0])
        grid = max(p.numel() * p.element_size() for p in trainer.method.parameters())
        if grid != side**3 * VALUES_BYTES:  # a grid grows from a coarse one
            raise UserError(f"its vertices are not reached after {trainer.step_count:,} steps: give a larger --budget")
        return (yield from measured(trainer, bench, selection)) | {"side": side}

    def report(self, subject: Subject, results: Mapping[str, Result], pictures: Path, figures: bool) -> Report:
        done = sorted((r for r in results.values() if "failed" not in r), key=lambda r: r["side"])
        lines = tuple(
            (f"{r['side']}", size(r["side"] ** 3 * VALUES_BYTES), cell(r["psnr"], 2), cell(r["ssim"], 3),
             cell(r["seconds"], 0), f"{r['steps']:,}")
            for r in done
        )  # fmt: skip
        notes = [
            phrase(
                "The grid takes N³ × {bytes} bytes; with gradient and Adam's moments, four times that.",
                bytes=VALUES_BYTES,
            )
        ]
        if len(done) > 2:
            a, b = done[-2:]
            notes.append(
                phrase(
                    "From N = {begin} to {end}, memory grows by {times:.1f} times and PSNR by {gain} dB.",
                    begin=a["side"],
                    end=b["side"],
                    times=(b["side"] / a["side"]) ** 3,
                    gain=number(b["psnr"] - a["psnr"], 2),
                )
            )
        notes += failures(results, {key: key.replace("side-", "N = ") for key in results})
        columns = ("N", marked("memory"), marked("PSNR dB"), "SSIM", marked("training s"), marked("steps"))
        title = phrase("A dense RGBα grid, {budget} of training each", budget=spelled(self.budget))
        table = Table(title, columns, lines, tuple(notes))
        return Report((table,), {"memory": memory_plot(done, VALUES_BYTES)} if figures and done else {})
