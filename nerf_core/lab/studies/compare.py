"""`nerf-core lab compare`: the lecture's table of results, on one capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from nerf_core.common.configs import constant
from nerf_core.common.errors import UserError
from nerf_core.common.language import listed, marked, phrase, phrases
from nerf_core.common.text import number, size
from nerf_core.geometry.scene import Scene
from nerf_core.lab.figures import comparison
from nerf_core.lab.published import published_for
from nerf_core.lab.records import Report, Result, Row, Table
from nerf_core.lab.study import STUDIES, Bench, Subject, Work, budget, checked, chosen, spelled
from nerf_core.lab.tables import cell, failures
from nerf_core.lab.training import measured, trained
from nerf_core.methods import METHODS
from nerf_core.training.evaluate import Selection, select
from nerf_core.training.settings import RunSettings

# From the simplest to the paper's: the order of the table. Others follow by name.
ORDER = ("nearest-view", "rgba-grid", "neural-volumes", "srn", "mpi", "nerf", "nerf-guided", "voxels", "hash")
NERF_FAMILY = ("nerf", "nerf-guided", "voxels", "hash")


@STUDIES.register("compare")
@dataclass(frozen=True)
class Compare:
    """Every method under one budget: pictures side by side, PSNR, SSIM, time, memory, and the published means."""

    title: ClassVar[str] = marked("Compare methods")
    summary: ClassVar[str] = marked(
        "Every method learns the same photos for the same time, and draws the same held-out views."
    )
    order: ClassVar[int] = 0
    of_scene: ClassVar[bool] = True

    methods: str = constant("all", marked("which methods, with commas between; all: every one that the capture suits"))
    budget: str = constant(
        "60s", marked("of each method: training time such as 90s or 10m, or a number such as 200steps")
    )
    views: int = constant(3, marked("held-out views that are drawn, evenly spread"), least=1, most=10_000)
    seed: int = constant(0, marked("of everything random"))

    def __post_init__(self) -> None:
        checked(self)
        budget(self.budget)

    def plan(self, subject: Subject) -> tuple[Row, ...]:
        known = sorted(METHODS.names(), key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))
        self._selection(subject)
        return tuple(Row(name, name, {"method": name}) for name in chosen(self.methods, known, "--methods"))

    def _selection(self, subject: Subject) -> Selection:
        return select(subject.capture(), count=self.views)

    def work(self, subject: Subject, row: Row, bench: Bench) -> Work:
        selection = self._selection(subject)
        settings = RunSettings(method=row.values["method"], seed=self.seed)
        trainer = yield from trained(subject, bench, settings, budget(self.budget), selection.views[0])
        return (yield from measured(trainer, bench, selection))

    def report(self, subject: Subject, results: Mapping[str, Result], pictures: Path, figures: bool) -> Report:
        name, published = published_for(subject.capture())
        done = {key: result for key, result in results.items() if "failed" not in result}
        columns = (marked("method"), marked("PSNR dB"), "SSIM", marked("training s"), marked("steps"), marked("memory"))
        if name:
            columns += (
                phrase("published PSNR, {name}", name=name),
                marked("published SSIM"),
                marked("published LPIPS"),
            )
        lines = []
        for key, result in done.items():
            line = (key, cell(result["psnr"], 2), cell(result["ssim"], 3), cell(result["seconds"], 0),
                    f"{result['steps']:,}", size(result["bytes"]))  # fmt: skip
            theirs = published.get(key)
            if name:
                line += (
                    ("–", "–", "–")
                    if theirs is None
                    else (cell(theirs.psnr, 2), cell(theirs.ssim, 3), cell(theirs.lpips, 3))
                )
            lines.append(line)
        notes = failures(results, {key: key for key in results})
        if done:
            notes = (*_seen(done), _aside(subject.capture(), self._selection(subject)), *notes)
        selection = self._selection(subject)
        views = phrases("{n:,} {split} view", "{n:,} {split} views", len(selection.views), split=selection.split)
        title = phrase("Results, {budget} of training each, {views}", budget=spelled(self.budget), views=views)
        table = Table(title, columns, tuple(lines), notes)
        if not (figures and done):
            return Report((table,))
        try:
            drawn = comparison(subject.capture(), selection.views, done, tuple(done), pictures)
        except OSError as error:
            raise UserError(f"{error.filename}: cannot be read ({error.strerror}): run the study again") from None
        return Report((table,), {"compare": drawn})


def _seen(done: Mapping[str, Result]) -> tuple[str, ...]:
    """Return what the table shows, in sentences."""
    best = max(done, key=lambda key: done[key]["psnr"])
    others = [key for key in done if key not in NERF_FAMILY]
    text = [phrase("First by PSNR is {best}.", best=best)]
    if others and best in NERF_FAMILY:
        rival = max(others, key=lambda key: done[key]["psnr"])
        ahead = done[best]["psnr"] - done[rival]["psnr"]
        text.append(phrase("The best of the others is {rival}, {ahead:.1f} dB behind.", rival=rival, ahead=ahead))
    text.append(phrase("Memory is that of the parameters alone."))
    return (
        listed(text, " "),
        marked(
            "The published means are of another protocol: all scenes, whole test sets, hours of training. Beside mpi "
            "stands LLFF, whose network is not used here; beside neural-volumes and srn the papers' whole systems."
        ),
    )


def _aside(scene: Scene, selection: Selection) -> str:
    """Return a sentence about how far the drawn views are from training cameras: nearest-view lives on that."""
    eyes = scene.poses[:, :, 3]
    train = eyes[list(scene.split("train"))]
    apart = sorted(float(np.linalg.norm(train - eyes[view], axis=-1).min()) for view in selection.views)
    return phrase(
        "The drawn views lie {nearest} to {farthest} units from the nearest training camera; the scene's radius is "
        "{radius}.",
        nearest=number(apart[0], 2),
        farthest=number(apart[-1], 2),
        radius=number(scene.radius, 2),
    )
