"""`nerf-core lab sampling`: uniform against hierarchical sampling at equal numbers of network calls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from nerf_core.common.configs import constant
from nerf_core.common.errors import UserError
from nerf_core.common.language import marked, phrase, phrases
from nerf_core.lab.figures import sampling_plot
from nerf_core.lab.records import Report, Result, Row, Table
from nerf_core.lab.study import STUDIES, Bench, Subject, Work, budget, checked, spelled
from nerf_core.lab.tables import failures, numbers, spread
from nerf_core.lab.training import measured, trained
from nerf_core.training.evaluate import select
from nerf_core.training.settings import RunSettings

WAYS = (marked("uniform"), marked("hierarchical"))


@STUDIES.register("sampling")
@dataclass(frozen=True)
class Sampling:
    """The lecture's "how to choose the points": PSNR against network calls per ray, uniform and hierarchical."""

    title: ClassVar[str] = marked("How to choose the points")
    summary: ClassVar[str] = marked(
        "Evenly spaced samples against coarse ones that say where the fine ones go, for the same number of network "
        "calls per ray."
    )
    order: ClassVar[int] = 3
    of_scene: ClassVar[bool] = True

    calls: str = constant(
        "16,32,64,128", marked("network calls per ray, multiples of 4 from 12 up, with commas between")
    )
    budget: str = constant(
        "1500steps", marked("of each row: a number such as 200steps, or training time such as 90s or 10m")
    )
    views: int = constant(3, marked("held-out views that are measured, evenly spread"), least=1, most=10_000)
    seeds: int = constant(1, marked("how many seeds each row is trained with"), least=1, most=100)
    preset: str = constant("auto", marked("of the method nerf, to which the numbers of samples are applied"))

    def __post_init__(self) -> None:
        checked(self)
        budget(self.budget)
        self._calls()

    def _calls(self) -> tuple[int, ...]:
        try:
            found = sorted({int(text) for text in self.calls.split(",")})
        except ValueError:
            found = []
        if not found or found[0] < 12 or found[-1] > 4096 or any(n % 4 for n in found):
            raise UserError(f"--calls {self.calls}: give multiples of 4 from 12 to 4096, with commas between")
        return tuple(found)

    def plan(self, subject: Subject) -> tuple[Row, ...]:
        return tuple(
            Row(f"{way}-{n}-{seed}", self._label(way, n, seed),
                {"way": way, "calls": n, "seed": seed})
            for n in self._calls() for way in WAYS for seed in range(self.seeds)
        )  # fmt: skip

    def _label(self, way: str, calls: int, seed: int) -> str:
        name = phrases("{way}, {n} call", "{way}, {n} calls", calls, way=phrase(way))
        return phrase("{name}, seed {seed}", name=name, seed=seed) if self.seeds > 1 else name

    def work(self, subject: Subject, row: Row, bench: Bench) -> Work:
        selection, n = select(subject.capture(), count=self.views), row.values["calls"]
        samples = placed(row.values["way"], n)
        changes = {"coarse_samples": str(samples[0]), "fine_samples": str(samples[1])}
        settings = RunSettings(method="nerf", preset=self.preset, changes=changes, seed=row.values["seed"])
        trainer = yield from trained(subject, bench, settings, budget(self.budget), selection.views[0])
        return (yield from measured(trainer, bench, selection)) | row.values

    def report(self, subject: Subject, results: Mapping[str, Result], pictures: Path, figures: bool) -> Report:
        done = [r for r in results.values() if "failed" not in r]
        lines, groups = [], {}
        for n in sorted({r["calls"] for r in done}):
            for way in WAYS:
                own = [r for r in done if (r["calls"], r["way"]) == (n, way)]
                if own:
                    groups[way, n] = [r["psnr"] for r in own]
                    c, f = placed(way, n)
                    lines.append((f"{n}", way, f"({c}, {f or '–'})", spread(numbers(own, "psnr"), 2),
                                  spread(numbers(own, "ssim"), 3), spread(numbers(own, "steps"), 0)))  # fmt: skip
        notes = (
            marked("Calls: a hierarchical ray asks the coarse network N_c times and the fine one N_c + N_f times."),
            *failures(results, {key: key for key in results}),
        )
        columns = (marked("calls per ray"), marked("samples"), "(N_c, N_f)", marked("PSNR dB"), "SSIM", marked("steps"))
        title = phrase("Uniform and hierarchical sampling, {budget} each", budget=spelled(self.budget))
        table = Table(title, columns, tuple(lines), notes)
        return Report((table,), {"sampling": sampling_plot(groups)} if figures and groups else {})


def placed(way: str, calls: int) -> tuple[int, int]:
    """Return (N_c, N_f) with N_c calls of one network, or N_c of the coarse and N_c + N_f of the fine network.

    N_f is twice N_c, as in the paper's (64, 128), whose 256 calls its row without hierarchy makes with (256, –).
    """
    return (calls, 0) if way == "uniform" else (calls // 4, calls // 2)
