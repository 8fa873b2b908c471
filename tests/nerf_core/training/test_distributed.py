"""Several processes train like one process with the batch of all; they stop, continue and fail together."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from several import TROUBLES, Outcome, Scenario

from nerf_core.cli import main
from nerf_core.training import checkpoint

pytestmark = pytest.mark.thorough(35)  # all use one fixture, in which a dozen processes begin
ROOT = Path(__file__).parents[3]
STEPS = 20
# Two of these processes share the second of three chunks, 24 + 24 rays of 16 + 16 + 16.
NERF = [
    "--method", "nerf", "--set", "coarse_samples=8", "--set", "fine_samples=8", "--set", "depth=2",
    "--set", "width=32", "--set", "learning_rate=2e-3", "--set", "chunk_rays=16", "--set", "precision=float32",
    "--set", "density_noise=0.5",
]  # fmt: skip
# The occupancy is updated every 5 steps, after the first time in cells drawn at random: there are 36³, above FEW.
HASH = [
    "--method", "hash", "--set", "levels=4", "--set", "log2_rows=10", "--set", "update_every=5",
    "--set", "warm_updates=1", "--set", "cells=36",
]  # fmt: skip
BATCHES = {"nerf": (NERF, "rays", 24), "hash": (HASH, "samples", 6000)}


class Ran(NamedTuple):
    """The folder of all runs, and what each of the two processes did by the scenario's name."""

    folder: Path
    outcomes: dict[str, tuple[Outcome, Outcome]]


def train(capture: Path, out: Path, method: str, processes: int, *more: str, steps: int = STEPS) -> list[str]:
    """A command line whose batch is that of so many processes."""
    options, name, size = BATCHES[method]
    batch = ["--set", f"{name}={processes * size}", "--steps", str(steps)]
    return ["train", str(capture), "--out", str(out), "--device", "cpu", "--threads", "1", *options, *batch, *more]


def torchrun(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2", *arguments]
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "helpers")])
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


@pytest.fixture(scope="module")
def ran(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """All that two processes do here; a process takes two seconds of a core to begin, so they do it one by one."""
    folder = tmp_path_factory.mktemp("runs")

    def scenario(name: str, *more: str, method: str = "nerf", trouble: str = "", step: int = 0) -> Scenario:
        return Scenario(name, train(capture, folder / name, method, 1, *more), trouble, step)

    resumed = ["train", "--out", str(folder / "stopped"), "--device", "cpu", "--resume"]
    scenarios = [
        scenario("nerf"),
        scenario("hash", method="hash"),
        scenario("stopped", trouble="stopped", step=5),
        Scenario("resumed", resumed),
        scenario("timed", "--seconds", "0.000001"),
        scenario("hung", trouble="hung", step=4),
        scenario("failed", trouble="failed", step=3),
        scenario("parted", trouble="parted", step=5),
        scenario("mistaken", "--set", "wings=2"),
        Scenario("alone", ["train", str(capture), "--out", str(folder / "alone"), "--device", "cpu"]),
    ]
    assert {s.trouble for s in scenarios} == {"", *TROUBLES}
    (folder / "scenarios.json").write_text(json.dumps([asdict(one) for one in scenarios]), encoding="utf-8")
    done = torchrun("-m", "several", str(folder))
    assert done.returncode == 0, done.stderr
    files = {s.name: [folder / f"{s.name}.{rank}.json" for rank in range(2)] for s in scenarios}
    read = {name: [Outcome(**json.loads(f.read_text(encoding="utf-8"))) for f in both] for name, both in files.items()}
    return Ran(folder, {name: (first, second) for name, (first, second) in read.items()})


def losses(run: Path) -> torch.Tensor:
    """The loss of every step, float64."""
    return checkpoint.newest(run)[2]["history.losses"]


def error_of(outcomes: Sequence[Outcome]) -> str:
    """The one line that the first of the failed processes printed; the second one printed nothing."""
    first, second = outcomes
    assert (first.status, second.status) == (2, 2)
    assert (second.out, second.err) == ("", "")
    assert first.err.startswith("nerf-core: ")
    assert first.err.count("\n") == 1
    return first.err


@pytest.mark.parametrize("method", BATCHES)
def test_two_processes_learn_like_one_with_the_double_batch(
    method: str, ran: Ran, capture: Path, tmp_path: Path
) -> None:
    first, second = ran.outcomes[method]
    assert (first.status, second.status) == (0, 0)
    assert f"finished: step {STEPS} after" in first.out
    assert (first.err, second.out, second.err) == ("", "", "")
    assert main(train(capture, tmp_path / "one", method, 2)) == 0
    assert "nerf_core.training.distributed" not in sys.modules  # only torchrun's processes need it
    one, two = losses(tmp_path / "one"), losses(ran.folder / method)
    assert len(one) == STEPS
    torch.testing.assert_close(two, one, rtol=1e-5, atol=0)
    assert one[-1] < 0.9 * one[0]  # it learnt
    assert main(train(capture, tmp_path / "half", method, 1, steps=1)) == 0
    assert abs(losses(tmp_path / "half")[0] / one[0] - 1) > 1e-2  # the batch matters


def test_a_signal_to_one_process_stops_all_and_is_resumed_bit_for_bit(ran: Ran) -> None:
    first, second = ran.outcomes["stopped"]
    assert (first.status, second.status) == (143, 143)
    assert "stopped: step 6 after" in first.out  # the step under way is finished by all
    first, second = ran.outcomes["resumed"]
    assert (first.status, second.status) == (0, 0)
    assert "note" not in first.out
    straight, parts = (checkpoint.newest(ran.folder / name) for name in ("nerf", "stopped"))
    assert straight[1]["step"] == parts[1]["step"] == STEPS
    assert straight[1]["processes"] == parts[1]["processes"] == 2
    assert [name for name, value in straight[2].items() if not value.equal(parts[2][name])] == []


def test_one_process_continues_what_two_began(ran: Ran, capsys: pytest.CaptureFixture[str]) -> None:
    out = ran.folder / "timed"
    assert "finished: step 1 after" in ran.outcomes["timed"][0].out  # the first process's clock decides
    assert main(["train", "--out", str(out), "--device", "cpu", "--resume", "--steps", "3"]) == 0
    assert "note: begun with 2, continued with 1 processes: a step has the rays of all" in capsys.readouterr().out
    assert checkpoint.newest(out)[1]["processes"] == 1


def test_an_error_in_one_process_ends_all_and_loses_no_step(ran: Ran) -> None:
    assert error_of(ran.outcomes["failed"]) == "nerf-core: process 1: no luck; step 3 is saved\n"
    assert checkpoint.newest(ran.folder / "failed")[1]["step"] == 3


def test_processes_with_other_weights_are_noticed(ran: Ran) -> None:
    assert "step 6: the processes of torchrun do not have the same weights" in error_of(ran.outcomes["parted"])


def test_a_process_that_does_not_answer_is_not_waited_for_longer_than_patience(ran: Ran) -> None:
    assert "another process of torchrun ended or does not answer" in error_of(ran.outcomes["hung"])
    assert checkpoint.newest(ran.folder / "hung")[1]["step"] == 4


def test_a_mistake_on_the_command_line_is_told_once(ran: Ran) -> None:
    assert "--set 'wings': method nerf has no such constant" in error_of(ran.outcomes["mistaken"])


def test_a_method_that_trains_in_one_process_is_refused(ran: Ran) -> None:
    told = "nerf-core: method voxels trains in one process: torchrun works with hash and nerf\n"
    assert error_of(ran.outcomes["alone"]) == told
    assert not (ran.folder / "alone").exists()
