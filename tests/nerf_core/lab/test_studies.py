"""Every study runs to its report, goes on where it was interrupted, and refuses a folder of another one."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from PIL import Image

from nerf_core.common.configs import changed, constant, constants
from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions
from nerf_core.geometry.scene import Scene
from nerf_core.lab.figures import detailed
from nerf_core.lab.job import StudyJob
from nerf_core.lab.records import Advance, Knob, Report, Result, Row, Table
from nerf_core.lab.study import STUDIES, Bench, Study, Subject, Work, budget, checked, chosen
from nerf_core.lab.tables import spread
from nerf_core.lab.training import _must_be
from nerf_core.training import trainer as training
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

# The options that make a study small enough for a test. A study of a plug-in takes one step a row, if it has a budget.
SMALL: dict[str, dict[str, str]] = {
    "compare": {"methods": "voxels", "budget": "2steps", "views": "1"},
    "ablate": {"rows": "1,3,9", "budget": "1steps", "views": "1"},
    "memory": {"sides": "4,8", "budget": "2steps", "views": "1"},
    "image": {"size": "16", "steps": "6"},
    "flatland": {"steps": "3", "cameras": "2", "coarse": "8", "fine": "4"},
    "sampling": {"calls": "12", "budget": "1steps", "views": "1"},
}


def subject_of(scene: Scene) -> Subject:
    return Subject(None, LoadOptions(), scene, "cpu")


def made(name: str, scene: Scene, folder: Path, **options: str) -> StudyJob:
    study: Any = STUDIES.get(name)()
    small = SMALL.get(name, {"budget": "1steps"} if "budget" in constants(type(study)) else {})
    study = changed(study, small | options, name)
    subject = subject_of(scene) if study.of_scene else Subject(None, LoadOptions(), None, "cpu")
    return StudyJob(study, subject, folder)


def through(job: StudyJob) -> StudyJob:
    while job.advance():
        pass
    return job


@pytest.mark.parametrize("name", STUDIES.names())
def test_a_study_runs_to_its_report(name: str, scene: Scene, tmp_path: Path) -> None:
    job = made(name, scene, tmp_path)
    assert {row.state for row in job.progress.rows} == {"waiting"}
    fractions = []
    while job.advance():
        fractions.append(job.progress.fraction)
    assert job.progress.state == "done"
    assert fractions == sorted(fractions)
    assert [row.state for row in job.progress.rows] == ["done"] * len(job.progress.rows), job.progress.rows
    assert len({row.key for row in job.study.plan(job.subject)}) == len(job.progress.rows)
    report, *figures = job.progress.files
    text = report.read_text(encoding="utf-8")
    assert text.startswith(f"# {job.study.title}\n")
    assert figures or name not in SMALL  # a plug-in may leave a table alone
    for figure in figures:
        assert f"]({figure.name})" in text
        with Image.open(figure) as picture:
            assert min(picture.size) > 100
    for table in job.progress.tables:
        assert {len(row) for row in table.rows} == {len(table.columns)}
        assert table.markdown() in text
    results = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert [one["label"] for one in results.values()] == [row.label for row in job.progress.rows]


@pytest.mark.parametrize("name", STUDIES.names())
def test_a_finished_study_is_only_reported_again(name: str, scene: Scene, tmp_path: Path) -> None:
    first = through(made(name, scene, tmp_path))
    again = made(name, scene, tmp_path)
    pieces = 0
    while again.advance():
        pieces += 1
    assert pieces == 1  # the report
    assert {row.text for row in again.progress.rows} == {"kept from before"}
    assert again.progress.tables == first.progress.tables


@pytest.mark.parametrize("name", STUDIES.names())
def test_options_are_checked(name: str) -> None:
    for key, (default, about) in constants(STUDIES.get(name)).items():
        assert about.help[-1] != "."
        wrong = {int: "-1", float: "-1", str: "nonsense"}[type(default)]
        if isinstance(default, str) and key not in ("budget", "calls", "sides", "rows", "method"):
            continue
        with pytest.raises(UserError) as told:
            changed(STUDIES.get(name)(), {key: wrong}, name)
        assert key.replace("_", "-") in str(told.value)


@dataclass(frozen=True)
class Counting:
    """Counts to three in each row, and notes it."""

    title: ClassVar[str] = "Counting"
    summary: ClassVar[str] = "Counts."
    order: ClassVar[int] = 99
    of_scene: ClassVar[bool] = True
    noted: ClassVar[list[str]] = []

    rows: int = constant(2, "rows", least=1)
    breaks: int = constant(-1, "the row that is impossible", least=-1)

    def knobs(self) -> tuple[Knob, ...]:
        return (Knob("k", 0, 9, 3),)

    def plan(self, subject: Subject) -> tuple[Row, ...]:
        return tuple(Row(f"row-{k}", f"row {k}", {"k": k}) for k in range(self.rows))

    def work(self, subject: Subject, row: Row, bench: Bench) -> Work:
        file = bench.run / "count"
        count = int(file.read_text(encoding="utf-8")) if file.exists() else 0
        try:
            while count < 3:
                count += 1
                self.noted.append(f"{row.key} {count}")
                bench.tick()
                yield Advance(count / 3, f"counted {count}")
        except GeneratorExit:
            bench.run.mkdir(parents=True)
            file.write_text(str(count), encoding="utf-8")
            raise
        if row.values["k"] == self.breaks:
            raise UserError("it cannot be")
        return {"count": count, "turned": bench.turned.get("k")}

    def report(self, subject: Subject, results: Mapping[str, Result], pictures: Path, figures: bool) -> Report:
        rows = tuple((key, str(result.get("count"))) for key, result in results.items())
        return Report((Table("Counts", ("row", "a | b"), rows, ("A note.",)),))


@pytest.fixture
def counting(monkeypatch: pytest.MonkeyPatch) -> type[Counting]:
    STUDIES.names()  # loads the others
    monkeypatch.setitem(STUDIES._items, "counting", Counting)
    monkeypatch.setattr(Counting, "noted", [])
    return Counting


def counted(scene: Scene, folder: Path, **options: int) -> StudyJob:
    study: Study = Counting(**options)
    return StudyJob(study, subject_of(scene), folder)


def test_a_cancelled_study_goes_on_where_it_was(scene: Scene, tmp_path: Path, counting: type[Counting]) -> None:
    job = counted(scene, tmp_path)
    for _ in range(6):  # row 0 begins, three pieces, its result, row 1 begins
        assert job.advance()
    assert job.advance()
    job.cancel()
    assert job.progress.state == "cancelled"
    assert not job.advance()
    again = through(counted(scene, tmp_path))
    assert counting.noted == ["row-0 1", "row-0 2", "row-0 3", "row-1 1", "row-1 2", "row-1 3"]
    assert [row.text for row in again.progress.rows] == ["kept from before", ""]
    assert (tmp_path / "report.md").read_text(encoding="utf-8").count("| row-") == 2
    assert "| row | a \\| b |" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_cancelling_between_the_pieces_of_a_step_ends_after_it(
    scene: Scene, tmp_path: Path, counting: type[Counting]
) -> None:
    job = counted(scene, tmp_path)
    assert job.advance(job.cancel)  # row 0 begins
    assert not job.advance(job.cancel)
    assert job.progress.state == "cancelled"
    assert counting.noted == ["row-0 1"]
    assert (tmp_path / "runs" / "row-0" / "count").read_text(encoding="utf-8") == "1"


def test_a_row_that_was_cancelled_ends_as_if_it_had_not_been(scene: Scene, tmp_path: Path) -> None:
    whole = through(made("image", scene, tmp_path / "whole"))
    job = made("image", scene, tmp_path / "parts")
    for _ in range(12):
        job.advance()
    job.cancel()
    assert (tmp_path / "parts" / "runs" / "seed-0" / "networks.safetensors").is_file()
    parts = through(made("image", scene, tmp_path / "parts"))
    assert parts.progress.tables == whole.progress.tables
    first, second = (
        (tmp_path / name / "rows" / "seed-0.json").read_text(encoding="utf-8") for name in ("whole", "parts")
    )
    assert first == second
    (tmp_path / "parts" / "runs" / "seed-0" / "networks.safetensors").write_bytes(b"damaged")
    (tmp_path / "parts" / "rows" / "seed-0.json").unlink()
    again = through(made("image", scene, tmp_path / "parts"))
    assert "networks.safetensors: cannot be continued" in again.progress.rows[0].text


def test_a_trained_row_that_was_cancelled_goes_on_from_its_step(scene: Scene, tmp_path: Path) -> None:
    job = made("sampling", scene, tmp_path, budget="4steps")
    while "step 2" not in job.progress.text:
        job.advance()
    job.cancel()
    (stored,) = (tmp_path / "runs" / "uniform-12-0" / "checkpoints").glob("*.safetensors")
    assert stored.name == "step_00000002.safetensors"
    whole = through(made("sampling", scene, tmp_path / "whole", budget="4steps"))
    parts = through(made("sampling", scene, tmp_path, budget="4steps"))
    assert [row[:5] for row in parts.progress.tables[0].rows] == [row[:5] for row in whole.progress.tables[0].rows]


@pytest.mark.thorough(6)
def test_a_row_goes_on_from_its_own_checkpoint_alone(scene: Scene, tmp_path: Path) -> None:
    """What lies in a row's run folder may be of another seed or scene: then it is not measured under the row's name."""
    job = made("sampling", scene, tmp_path, budget="9steps")
    while "step 2" not in job.progress.text:
        job.advance()
    job.cancel()
    (tmp_path / "study.json").unlink()
    other = through(made("sampling", scene, tmp_path, budget="9steps", preset="complete"))
    assert "of another config than this row: delete" in other.progress.rows[0].text
    (tmp_path / "study.json").unlink()
    changed_scene = replace(scene, near=scene.near + 0.5)
    other = through(made("sampling", changed_scene, tmp_path, budget="9steps"))
    assert "of another scene than this row: delete" in other.progress.rows[0].text


def test_a_row_that_an_earlier_version_began_goes_on(scene: Scene, tmp_path: Path) -> None:
    """Its configuration lacks a constant that is new, whose value of then it has."""
    settings = RunSettings(method="voxels")
    described = Trainer(scene, settings).describe()
    before = {name: value for name, value in described["config"].items() if name != "slope"}
    _must_be(tmp_path, {**described, "config": before}, scene, settings)
    for config in (before | {"slope": 0.5}, before | {"rays": 7}, before | {"rays": "many"}, 3, None):
        with pytest.raises(UserError, match="of another config than this row"):
            _must_be(tmp_path, {**described, "config": config}, scene, settings)


def test_a_row_that_was_turned_is_not_kept(scene: Scene, tmp_path: Path, counting: type[Counting]) -> None:
    job = counted(scene, tmp_path)
    job.turn("k", 5.0)
    through(job)
    assert not list((tmp_path / "rows").glob("*.json"))
    assert [row.text for row in through(counted(scene, tmp_path)).progress.rows] == ["", ""]


def test_a_study_is_of_one_kind_of_device(scene: Scene, tmp_path: Path, counting: type[Counting]) -> None:
    through(counted(scene, tmp_path))
    file = tmp_path / "study.json"
    file.write_text(file.read_text(encoding="utf-8").replace('"cpu"', '"cuda"'), encoding="utf-8")
    with pytest.raises(UserError, match="holds rows of kind of device 'cuda', and not of 'cpu'"):
        counted(scene, tmp_path)


def test_weights_that_are_not_finite_are_not_saved(scene: Scene, tmp_path: Path) -> None:
    job = made("sampling", scene, tmp_path, budget="9steps")
    step = Trainer.step

    def broken(trainer: Trainer, yield_callback: Callable[[], None]) -> training.Report:
        report = step(trainer, yield_callback)
        if trainer.step_count == 3:
            trainer.method.parameters()[0].data.fill_(np.nan)
            trainer.step_count = 9
        return report

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "step", broken)
        through(job)
    assert "the weights are not finite" in job.progress.rows[0].text
    assert not list((tmp_path / "runs").rglob("*.safetensors"))
    assert [row.state for row in through(made("sampling", scene, tmp_path, budget="9steps")).progress.rows] == [
        "done"
    ] * 2


def test_a_photo_is_asked_for_where_there_is_none(tmp_path: Path) -> None:
    file = tmp_path / "photo.png"
    file.write_text("no photo", encoding="utf-8")
    for wrong in (file, tmp_path / "nowhere.png"):
        with pytest.raises(UserError, match=wrong.name):
            StudyJob(STUDIES.get("image")(), Subject(wrong, LoadOptions(), None, "cpu"), tmp_path / "out")


def test_a_row_that_is_impossible_leaves_the_others_and_is_tried_again(
    scene: Scene, tmp_path: Path, counting: type[Counting]
) -> None:
    job = through(counted(scene, tmp_path, breaks=0))
    assert [(row.state, row.text) for row in job.progress.rows] == [("failed", "it cannot be"), ("done", "")]
    assert job.progress.state == "done"
    assert not (tmp_path / "rows" / "row-0.json").exists()
    through(counted(scene, tmp_path, breaks=0))
    assert counting.noted.count("row-0 1") == 2


def test_a_folder_of_another_study_is_refused(scene: Scene, tmp_path: Path, counting: type[Counting]) -> None:
    through(counted(scene, tmp_path))
    with pytest.raises(UserError, match="holds rows with --rows 2, and not with 3: take another --out"):
        counted(scene, tmp_path, rows=3)
    with pytest.raises(UserError, match="holds rows of study 'counting', and not of 'memory'"):
        made("memory", scene, tmp_path)
    (tmp_path / "study.json").write_text("{", encoding="utf-8")
    with pytest.raises(UserError, match=r"study\.json"):
        counted(scene, tmp_path)


@pytest.mark.parametrize("name", STUDIES.names())
@pytest.mark.parametrize("forged", [{}, {"psnr": "high"}, {"psnr": None, "images": 3}, {"encodings": {}}])
def test_forged_rows_are_refused_or_tabulated(name: str, forged: dict[str, Any], scene: Scene, tmp_path: Path) -> None:
    """A file of a row may hold anything: the study then says so in a line, and nothing is run or written elsewhere."""
    job = made(name, scene, tmp_path)
    (tmp_path / "rows").mkdir()
    for row in job.study.plan(job.subject):
        text = json.dumps({"row": row.values, "result": forged | row.values})
        (tmp_path / "rows" / f"{row.key}.json").write_text(text, encoding="utf-8")
    job.cancel()
    # What a plug-in has a table for is its own matter, as long as nothing but a line for the user is raised.
    with pytest.raises(UserError, match="not as this version writes") if name in SMALL else suppress(UserError):
        through(made(name, scene, tmp_path))


def test_a_knob_is_turned_within_its_range(scene: Scene, tmp_path: Path, counting: type[Counting]) -> None:
    job = counted(scene, tmp_path)
    job.turn("k", 100.0)
    assert job.progress.knobs == (Knob("k", 0, 9, 9.0),)
    with pytest.raises(UserError, match="nothing called 'q' to turn"):
        job.turn("q", 1)
    assert json.loads((through(job).folder / "results.json").read_text(encoding="utf-8"))["row-1"]["result"] == {
        "count": 3,
        "turned": 9.0,
    }


@pytest.mark.parametrize(
    ("text", "steps", "seconds"),
    [("90s", 10**9, 90.0), ("10m", 10**9, 600.0), ("1.5 h", 10**9, 5400.0), ("200steps", 200, np.inf)],
)
def test_budgets(text: str, steps: int, seconds: float) -> None:
    goal = budget(text)
    assert (goal.steps, goal.seconds) == (steps, seconds)


@pytest.mark.parametrize("text", ["", "10", "0s", "1.5steps", "-3s", "1..2s", "nans", "1e3s"])
def test_a_budget_that_cannot_be_read_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="--budget"):
        budget(text)


def test_names_are_chosen_from_a_list() -> None:
    assert chosen("all", ("a", "b"), "--methods") == ("a", "b")
    assert chosen("b, a,b", ("a", "b"), "--methods") == ("b", "a")
    for wrong in ("c", "a,c", "", ","):
        with pytest.raises(UserError, match="--methods"):
            chosen(wrong, ("a", "b"), "--methods")


def test_a_row_without_hierarchy_makes_as_many_network_calls(scene: Scene) -> None:
    kind: Any = STUDIES.get("ablate")
    study = kind(preset="complete")
    rows = {row.values["row"]: row.values["changes"] for row in study.plan(subject_of(scene))}
    assert rows[1] == {"position_frequencies": "0", "direction_frequencies": "0", "view_directions": "false",
                       "coarse_samples": "256", "fine_samples": "0"}  # fmt: skip
    assert rows[4] == {"coarse_samples": "256", "fine_samples": "0"}
    assert rows[5] == {"train_images": "1"}
    assert rows[7] == {"position_frequencies": "5", "direction_frequencies": "2"}
    assert rows[8] == {"position_frequencies": "15", "direction_frequencies": "6"}
    assert rows[9] == {}


def test_a_spread_is_the_deviation_over_seeds() -> None:
    assert spread([1.0, 3.0], 2) == "2.00 ± 1.41"
    assert spread([1.0, None], 1) == "1.0"
    assert spread([None], 1) == "–"


def test_crops_are_where_the_detail_is() -> None:
    image = np.zeros((40, 60, 3), np.uint8)
    image[5:9, 7:11] = np.indices((4, 4)).sum(0)[..., None] % 2 * 255
    image[30:34, 50:54] = np.indices((4, 4)).sum(0)[..., None] % 2 * 200
    (y, x), (v, u) = detailed(image, 8, 2)
    for corner, begin in ((y, 5), (x, 7), (v, 30), (u, 50)):
        assert corner <= begin
        assert begin + 4 <= corner + 8


def test_a_checked_study_names_its_option() -> None:
    with pytest.raises(UserError, match=r"^--rows 0: must be at least 1"):
        checked(Counting(rows=0))
