"""The check of a capture's photos in the worker."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from desk import Desk

from nerf_core.live.messages import CancelReport, StartReport, Train, WriteReport


def test_a_check_runs_beside_training_and_is_written(open_desk: Callable[..., Desk], tmp_path: Path) -> None:
    desk = open_desk(steps=100_000)
    desk.send(Train())
    desk.send(StartReport())
    snapshot = desk.until(lambda s: s.report is not None and s.report.state == "done")
    assert snapshot.status == "training"
    assert snapshot.report is not None
    assert snapshot.report.report is not None
    assert snapshot.report.loaded == snapshot.loaded
    assert len(snapshot.report.report.photos) == 6
    page = tmp_path / "page.html"
    desk.send(WriteReport(file=page))
    notice = desk.until_told("wrote the capture report")
    assert notice.path == page
    assert notice.kind == "wrote"
    assert len(json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))["photos"]) == 6


def test_a_check_can_be_cancelled_and_needs_a_scene(open_desk: Callable[..., Desk], tmp_path: Path) -> None:
    desk = open_desk(opened=False)
    desk.send(StartReport())
    assert desk.until_told("no scene is open").level == "error"
    desk.send(WriteReport(file=tmp_path / "page.html"))
    assert desk.until_told("there is no capture report yet").level == "error"
    desk.send(CancelReport())
    assert desk.worker.snapshot().report is None
    assert list(tmp_path.iterdir()) == []
