"""`nerf-core lab`: what it writes and says, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nerf_core.cli import main
from nerf_core.lab.study import STUDIES

ROOT = Path(__file__).parents[3]
SMALL = ("--budget", "2steps", "--views", "1", "--device", "cpu")


def lab(*arguments: object) -> int:
    return main(["lab", *map(str, arguments)])


def test_a_study_prints_its_table_and_names_its_report(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert lab("memory", capture, "--out", tmp_path / "out", "--sides", "4,6", *SMALL) == 0
    said = capsys.readouterr().out
    assert "A dense RGBα grid, 2 steps of training each" in said
    assert said.splitlines()[-1] == f"2 rows; wrote {tmp_path / 'out' / 'report.md'}"
    assert (tmp_path / "out" / "memory.png").is_file()


def test_the_folder_is_named_after_scene_and_study(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert lab("memory", capture, "--sides", "4", *SMALL) == 0
    assert (tmp_path / "lab" / f"{capture.name}-memory" / "report.md").is_file()


def test_a_rows_run_folder_is_one(capture: Path, tmp_path: Path) -> None:
    assert lab("memory", capture, "--out", tmp_path, "--sides", "4", *SMALL) == 0
    run = tmp_path / "runs" / "side-4"
    assert main(["eval", str(run), "--views", "1"]) == 0
    assert main(["probe", str(run), "--camera", "0", "--pixel", "3", "4"]) in (0, 2)
    assert (run / "metrics.json").is_file()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("memory", "--sides", "x"), "--sides x: give whole numbers from 2 to 512, with commas between"),
        (("memory", "--sides", "1"), "--sides 1: give whole numbers"),
        (("compare", "--budget", "ten"), "--budget 'ten': give a time or a number of steps"),
        (("compare", "--methods", "nothing"), "--methods 'nothing': choose all, or some of"),
        (("sampling", "--calls", "10"), "--calls 10: give multiples of 4 from 12 to 4096"),
        (("ablate", "--rows", "10"), "--rows 10: give numbers from 1 to 9"),
        (("ablate", "--method", "voxels"), "--method voxels: choose nerf or nerf-guided"),
        (("ablate", "--method", "nerf-guided"), "leave the rows 1 and 4 out"),
        (("image", "--size", "1"), "--size 1: must be at least 16"),
        (("compare", "--workers", "here"), "--workers 'here': give the address of a Ray cluster"),
        (("nothing",), "nothing"),
        (("compare", "--views", "x"), "--views"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    capture: Path, tmp_path: Path, arguments: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    about = [] if arguments[0] in ("image", "nothing") else [capture]
    assert lab(arguments[0], *about, *arguments[1:], "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert told in said[0]


def test_a_study_without_any_result_fails(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert lab("compare", capture, "--out", tmp_path, "--methods", "mpi", *SMALL) == 2
    assert "no row could be done: method mpi needs a forward-facing capture" in capsys.readouterr().err
    assert lab("compare", capture, "--out", tmp_path / "two", "--methods", "mpi,voxels", *SMALL) == 0
    assert "method mpi needs a forward-facing capture" in (tmp_path / "two" / "report.md").read_text(encoding="utf-8")


def test_a_grid_that_is_not_reached_is_no_row_of_the_table(capture: Path, tmp_path: Path) -> None:
    assert lab("memory", capture, "--out", tmp_path, "--sides", "4,64", *SMALL) == 0
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "N = 64: its vertices are not reached after 2 steps: give a larger --budget." in report
    assert "| 64 |" not in report


def test_every_study_has_a_help(capsys: pytest.CaptureFixture[str]) -> None:
    for name in STUDIES.names():
        with pytest.raises(SystemExit) as end:
            lab(name, "--help")
        assert end.value.code == 0
        assert "--out" in capsys.readouterr().out


def test_ctrl_c_keeps_what_is_done(capture: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "nerf_core.cli", "lab", "memory", str(capture), "--out", str(tmp_path),
               "--sides", "4,6", "--budget", "400000steps", "--views", "1"]  # fmt: skip
    env = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as study:
        end = time.monotonic() + 120
        while not (tmp_path / "runs" / "side-4" / "config.json").exists() and time.monotonic() < end:
            time.sleep(0.05)
        time.sleep(1)
        study.send_signal(signal.SIGINT)
        assert study.wait(60) == 130
        assert study.stdout is not None
        assert b"interrupted" in study.stdout.read()
    assert list((tmp_path / "runs" / "side-4" / "checkpoints").glob("*.safetensors"))
