"""A study beside the open models: it shares the time with them, can be cancelled, and leaves them as they are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from desk import Desk

from nerf_core.lab.study import STUDIES
from nerf_core.live.messages import CancelStudy, Pause, StartStudy, Train, TurnKnob, ViewRequest

OpenDesk = Callable[..., Desk]
SMALL = {"methods": "voxels,hash", "budget": "10steps", "views": "1"}


def test_a_study_runs_beside_training_and_is_reported(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    desk.send(Train(), StartStudy("compare", SMALL, tmp_path))
    running = desk.until(lambda s: s.study is not None and s.study.fraction > 0.1)
    assert running.study is not None
    done = desk.until(lambda s: s.study is not None and s.study.state != "running")
    assert done.study is not None
    assert done.study.state == "done", desk.heard
    assert done.step > running.step  # both had their share
    assert [row.state for row in done.study.rows] == ["done", "done"]
    assert {look.name for look in done.study.looks} == {"voxels", "hash"}
    assert [figure.name for figure in done.study.figures] == ["compare"]
    assert (tmp_path / "report.md") in done.study.files
    assert desk.until_told("study compare: 2 rows").path == tmp_path / "report.md"


def test_a_study_is_cancelled_and_goes_on_later(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    desk.send(StartStudy("compare", SMALL | {"budget": "100000steps"}, tmp_path))
    desk.until(lambda s: s.study is not None and "step" in s.study.text)
    desk.send(CancelStudy())
    ended = desk.until(lambda s: s.study is not None and s.study.state != "running").study
    assert ended is not None
    assert ended.state == "cancelled"
    assert list((tmp_path / "runs" / "voxels" / "checkpoints").glob("*.safetensors"))
    desk.send(StartStudy("compare", SMALL | {"budget": "100000steps"}, tmp_path))
    again = desk.until(lambda s: s.study is not None and s.study.state == "running" and "step" in s.study.text).study
    assert again is not None
    desk.send(CancelStudy())


def test_pictures_and_commands_go_on_during_a_study(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    scene = desk.until(lambda s: s.scene is not None).scene
    assert scene is not None
    desk.send(StartStudy("compare", SMALL | {"budget": "100000steps"}, tmp_path))
    desk.until(lambda s: s.study is not None and "step" in s.study.text)
    desk.worker.request_view(ViewRequest(7, scene.views[0].camera, False))
    desk.until(lambda s: s.preview is not None and s.preview.stamp == 7 and s.preview.complete)
    desk.send(Train(steps=3), Pause())  # neither is quick: they wait for a piece of the study
    desk.until(lambda s: s.status != "training")
    study = desk.worker.snapshot().study
    assert study is not None
    assert study.state == "running"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"methods": "nothing"}, "--methods 'nothing': choose all, or some of"),
        ({"budget": "soon"}, "--budget 'soon': give a time or a number of steps"),
        ({"nonsense": "1"}, "method compare has no such constant"),
    ],
)
def test_what_cannot_be_started_is_said(
    open_desk: OpenDesk, tmp_path: Path, options: dict[str, str], told: str
) -> None:
    desk = open_desk()
    desk.send(StartStudy("compare", options, tmp_path))
    desk.until_told(told)
    assert desk.worker.snapshot().study is None


def test_there_is_one_study_at_a_time(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    desk.send(StartStudy("compare", SMALL | {"budget": "100000steps"}, tmp_path))
    desk.send(StartStudy("sampling", {}, tmp_path / "other"))
    desk.until_told("the study compare runs: cancel it or wait for it")
    desk.send(TurnKnob("L", 3.0))
    desk.until_told("nothing called 'L' to turn")
    desk.send(CancelStudy(), TurnKnob("L", 3.0))
    desk.until_told("no study runs")


def test_a_fault_in_a_study_leaves_the_models_alone(
    open_desk: OpenDesk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object) -> None:
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr(STUDIES.get("compare"), "work", broken)
    desk = open_desk()
    desk.send(Train(), StartStudy("compare", SMALL, tmp_path))
    assert "broken" in desk.until_told("the study failed: ZeroDivisionError: a fault").detail
    assert desk.until(lambda s: s.study is not None and s.study.state == "failed").status == "training"
