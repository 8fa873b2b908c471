"""`nerf-core lab ablate`: the nine rows of the paper's table 2, which the lecture shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, ClassVar, NamedTuple

import torch

from nerf_core.common.configs import constant
from nerf_core.common.device import pick_device
from nerf_core.common.errors import UserError
from nerf_core.common.language import listed, marked, phrase
from nerf_core.common.text import NOTHING
from nerf_core.lab.figures import ablation_plot
from nerf_core.lab.published import ABLATIONS
from nerf_core.lab.records import Report, Result, Row, Table
from nerf_core.lab.study import STUDIES, Bench, Subject, Work, budget, checked, spelled
from nerf_core.lab.tables import cell, failures, numbers, spread
from nerf_core.lab.training import measured, trained
from nerf_core.methods import METHODS
from nerf_core.training.evaluate import select
from nerf_core.training.metrics import Lpips
from nerf_core.training.settings import RunSettings

COMPLETE = 9
LEARNT = 15.0  # dB: below it a picture is a blur of the mean colour


class Ablation(NamedTuple):
    """A row of the table: its name, its input, and whether positions are encoded and sampling is hierarchical.

    images: the share of the training photos that it learns.
    frequencies: the factor on the numbers of frequencies.
    """

    name: str
    input: str
    encoded: bool = True
    directions: bool = True
    hierarchy: bool = True
    images: float = 1.0
    frequencies: float = 1.0


TABLE = {
    1: Ablation("No PE, VD, H", "xyz", encoded=False, directions=False, hierarchy=False),
    2: Ablation("No Pos. Encoding", "xyzθφ", encoded=False),
    3: Ablation("No View Dependence", "xyz", directions=False),
    4: Ablation("No Hierarchical", "xyzθφ", hierarchy=False),
    5: Ablation("Far Fewer Images", "xyzθφ", images=0.25),
    6: Ablation("Fewer Images", "xyzθφ", images=0.5),
    7: Ablation("Fewer Frequencies", "xyzθφ", frequencies=0.5),
    8: Ablation("More Frequencies", "xyzθφ", frequencies=1.5),
    COMPLETE: Ablation("Complete Model", "xyzθφ"),
}


@STUDIES.register("ablate")
@dataclass(frozen=True)
class Ablate:
    """The nine rows of the paper's ablation table with the same budget and seeds, ours beside the published ones."""

    title: ClassVar[str] = marked("Ablations")
    summary: ClassVar[str] = marked("What each part of the paper's model is good for: the nine rows of its table 2.")
    order: ClassVar[int] = 1
    of_scene: ClassVar[bool] = True

    method: str = constant("nerf", marked("nerf or nerf-guided: the methods with the paper's network"))
    preset: str = constant("auto", marked("of the method: the complete model, from which the rows differ"))
    budget: str = constant("10m", marked("of each row: training time such as 90s or 10m, or a number such as 200steps"))
    rows: str = constant("1,2,3,4,5,6,7,8,9", marked("rows of the table, with commas between"))
    seeds: int = constant(1, marked("how many seeds each row is trained with"), least=1, most=100)
    views: int = constant(3, marked("held-out views that are measured, evenly spread"), least=1, most=10_000)
    lpips_weights: str = constant(
        "", marked("VGG16 and LPIPS heads in one .safetensors file; without it LPIPS is not computed")
    )

    def __post_init__(self) -> None:
        checked(self)
        budget(self.budget)
        self._numbers()
        if self.method not in ("nerf", "nerf-guided"):
            raise UserError(f"--method {self.method}: choose nerf or nerf-guided, which have the paper's network")

    def _numbers(self) -> tuple[int, ...]:
        try:
            found = sorted({int(text) for text in self.rows.split(",")})
        except ValueError:
            found = [0]
        if not found or set(found) - set(TABLE):
            raise UserError(f"--rows {self.rows}: give numbers from 1 to 9, with commas between")
        return tuple(found)

    def plan(self, subject: Subject) -> tuple[Row, ...]:
        return tuple(
            Row(f"row-{n}-seed-{seed}", self._label(n, seed),
                {"row": n, "seed": seed, "changes": self._changes(subject, TABLE[n])})
            for seed in range(self.seeds) for n in self._numbers()
        )  # fmt: skip

    def _label(self, n: int, seed: int) -> str:
        name = f"{n}) {TABLE[n].name}"
        return phrase("{name}, seed {seed}", name=name, seed=seed) if self.seeds > 1 else name

    def _changes(self, subject: Subject, row: Ablation) -> dict[str, str]:
        """Return the constants in which a row differs from the complete model of the preset."""
        scene = subject.capture()
        whole: Any = METHODS.get(self.method).configure(scene, self.preset, {}, pick_device(subject.device))
        changes: dict[str, int | bool] = {}
        if not row.encoded:
            changes |= {"position_frequencies": 0, "direction_frequencies": 0}
        if not row.directions:
            changes["view_directions"] = False
        if not row.hierarchy:
            if self.method == "nerf-guided":
                raise UserError("--method nerf-guided has no hierarchy of networks: leave the rows 1 and 4 out, --rows")
            # as many network calls a ray as with two networks: (256, –) for (64, 128)
            changes |= {"coarse_samples": 2 * whole.coarse_samples + whole.fine_samples, "fine_samples": 0}
        if row.images < 1:
            changes["train_images"] = max(1, round(row.images * len(scene.split("train"))))
        if row.frequencies != 1:
            changes |= {name: round(row.frequencies * getattr(whole, name))
                        for name in ("position_frequencies", "direction_frequencies")}  # fmt: skip
        return {name: str(value).lower() for name, value in changes.items()}

    def work(self, subject: Subject, row: Row, bench: Bench) -> Work:
        selection = select(subject.capture(), count=self.views)
        settings = RunSettings(
            method=self.method, preset=self.preset, changes=row.values["changes"], seed=row.values["seed"]
        )
        trainer = yield from trained(subject, bench, settings, budget(self.budget), selection.views[0])
        lpips = Lpips(Path(self.lpips_weights), torch.device(trainer.device)) if self.lpips_weights else None
        config: Any = trainer.config
        about = {name: getattr(config, name, None) for name in
                 ("position_frequencies", "coarse_samples", "fine_samples", "train_images")}  # fmt: skip
        return (yield from measured(trainer, bench, selection, lpips)) | about | row.values

    def report(self, subject: Subject, results: Mapping[str, Result], pictures: Path, figures: bool) -> Report:
        done = [r for r in results.values() if "failed" not in r]
        photos = len(subject.capture().split("train"))
        lines, groups = [], {}
        for n in sorted({r["row"] for r in done}):
            own = [r for r in done if r["row"] == n]
            groups[n] = [r["psnr"] for r in own]
            first, paper = own[0], ABLATIONS[n]
            samples = NOTHING if first["coarse_samples"] is None else (
                f"({first['coarse_samples']}, {first['fine_samples'] or NOTHING})")  # fmt: skip
            lines.append((
                f"{n}) {TABLE[n].name}", TABLE[n].input, f"{first['train_images'] or photos}",
                f"{first['position_frequencies'] or NOTHING}", samples, spread(numbers(own, "psnr"), 2),
                spread(numbers(own, "ssim"), 3), spread(numbers(own, "lpips"), 3), cell(paper.psnr, 2),
                cell(paper.ssim, 3), cell(paper.lpips, 3),
            ))  # fmt: skip
        columns = ("", marked("input"), "#Im.", "L", "(N_c, N_f)", marked("PSNR dB"), "SSIM", "LPIPS",
                   marked("published PSNR"), "SSIM", "LPIPS")  # fmt: skip
        title = phrase(
            "Ablations of {method}, {budget} of training each", method=self.method, budget=spelled(self.budget)
        )
        if self.seeds > 1:
            title = phrase("{title}, {seeds} seeds, mean ± deviation", title=title, seeds=self.seeds)
        notes = (
            *_orders(groups),
            marked("The published means are over eight scenes at 800 × 800 after 500,000 steps or more."),
            *failures(results, {key: key for key in results}),
        )
        table = Table(title, columns, tuple(lines), notes)
        return Report((table,), {"ablate": ablation_plot(groups)} if figures and groups else {})


def _orders(groups: Mapping[int, Sequence[float]]) -> tuple[str, ...]:
    """Return sentences about the order of the rows by PSNR, here and in the paper."""
    if groups and max(mean(values) for values in groups.values()) < LEARNT:
        return (
            phrase(
                "No row has learnt anything yet (under {least:g} dB): the order means nothing at this budget.",
                least=LEARNT,
            ),
        )
    ours = sorted(groups, key=lambda n: mean(groups[n]))
    theirs = sorted(groups, key=lambda n: ABLATIONS[n].psnr)
    if ours == theirs:
        return (marked("The order of the rows by PSNR is that of the paper."),)
    found = [
        phrase(
            "Rows by PSNR from the worst: here {ours}; in the paper {theirs}.",
            ours=_listed(ours),
            theirs=_listed(theirs),
        )
    ]
    if COMPLETE in groups:
        complete = mean(groups[COMPLETE])
        better = [n for n in ours if mean(groups[n]) > complete]
        if better:
            gains = listed(phrase("{row}) by {gain:.2f} dB", row=n, gain=mean(groups[n]) - complete) for n in better)
            found.append(
                phrase("Other than in the paper, better than the complete model at this budget: {gains}.", gains=gains)
            )
    return tuple(found)


def _listed(rows: Sequence[int]) -> str:
    return ", ".join(str(n) for n in rows)
