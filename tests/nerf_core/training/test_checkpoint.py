"""An incomplete, damaged or foreign checkpoint is refused; writing one never harms the previous one."""

from __future__ import annotations

import errno
import json
import math
import os
import pickle
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from nerf_core.common.errors import UserError
from nerf_core.common.files import write_atomically
from nerf_core.common.json_files import finite
from nerf_core.training import checkpoint
from nerf_core.training.checkpoint import keep_newest, newest, step_path
from nerf_core.training.run_folder import RunFolder
from nerf_core.training.trainer import Trainer

DESCRIPTION: dict[str, Any] = {
    "method": "nerf", "config": {"rays": 3}, "steps": 10, "seed": 0, "threads": 1, "step": 4, "seconds": 1.5,
    "scene": "abc", "scene_name": "a \"quoted\" ball, größer", "scene_summary": "one photo",
}  # fmt: skip
TENSORS = {
    "a": torch.arange(12.0).view(3, 4), "b": torch.tensor(7.0), "c": torch.zeros(0, 2),
    "d": torch.arange(5, dtype=torch.uint8), "e": torch.ones(3, dtype=torch.bfloat16),
    "f": torch.arange(6).view(2, 3).T,
}  # fmt: skip


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    checkpoint.save(tmp_path / "run.safetensors", DESCRIPTION, TENSORS)
    return tmp_path / "run.safetensors"


def assert_intact(path: Path) -> None:
    description, tensors = checkpoint.load(path)
    assert description == DESCRIPTION
    assert tensors.keys() == TENSORS.keys()
    assert all(torch.equal(tensors[name], TENSORS[name]) for name in TENSORS)


def test_what_was_saved_is_loaded(saved: Path) -> None:
    assert_intact(saved)
    assert os.listdir(saved.parent) == [saved.name]


def test_a_trainer_survives_the_disk(make_trainer: Callable[..., Trainer], tmp_path: Path) -> None:
    trainer = make_trainer()
    trainer.step()
    checkpoint.save(tmp_path / "t.safetensors", trainer.describe(), trainer.state())
    description, tensors = checkpoint.load(tmp_path / "t.safetensors")
    assert description == trainer.describe()
    assert all(torch.equal(tensors[name], value) for name, value in trainer.state().items())


def test_every_flipped_byte_of_the_header_is_noticed(saved: Path) -> None:
    """One bit of each byte: lengths, names, types, shapes, offsets, the JSON, the version, the checksum itself."""
    whole = saved.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    for position in range(header):
        broken = bytearray(whole)
        broken[position] ^= 1 << (position % 8)
        saved.write_bytes(broken)
        with pytest.raises(UserError, match=r"run\.safetensors"):
            checkpoint.load(saved)


def test_every_flipped_byte_of_the_tensors_is_noticed(saved: Path) -> None:
    whole = saved.read_bytes()
    for position in range(8 + int.from_bytes(whole[:8], "little"), len(whole)):
        broken = bytearray(whole)
        broken[position] ^= 0xFF
        saved.write_bytes(broken)
        with pytest.raises(UserError, match="damaged: its checksum does not match; use an earlier checkpoint"):
            checkpoint.load(saved)


def test_a_truncated_file_is_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    for length in {0, 1, 7, 8, 9, len(whole) // 2, len(whole) - 1}:
        saved.write_bytes(whole[:length])
        with pytest.raises(UserError, match=r"not a readable checkpoint: .*use an earlier one"):
            checkpoint.load(saved)


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"gone\.safetensors: no such checkpoint"):
        checkpoint.load(tmp_path / "gone.safetensors")
    with pytest.raises(UserError, match="no such checkpoint"):
        checkpoint.load(tmp_path)


def test_a_newer_version_asks_for_an_update(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "new.safetensors"
    with monkeypatch.context() as context:
        context.setattr(checkpoint, "VERSION", checkpoint.VERSION + 1)
        checkpoint.save(path, DESCRIPTION, TENSORS)
    with pytest.raises(UserError, match="checkpoint version '2', this program reads up to 1: update it"):
        checkpoint.load(path)


def test_another_programs_safetensors_are_refused(tmp_path: Path) -> None:
    save_file({"weight": torch.ones(3)}, tmp_path / "llm.safetensors")
    with pytest.raises(UserError, match="a safetensors file, but not a checkpoint of nerf-viewer"):
        checkpoint.load(tmp_path / "llm.safetensors")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("step", None), ("seconds", "long"), ("config", []), ("step", True), ("step", -5), ("step", 10**400),
        ("seconds", math.nan), ("threads", -3), ("seed", 2**70),
    ],
)  # fmt: skip
def test_a_field_that_is_wrong_is_named(tmp_path: Path, field: str, value: object) -> None:
    checkpoint.save(tmp_path / "x.safetensors", DESCRIPTION | {field: value}, TENSORS)
    with pytest.raises(UserError, match=f"field {field} is missing, no .* or out of range"):
        checkpoint.load(tmp_path / "x.safetensors")


@pytest.mark.parametrize("text", ["", "nerf", "[" * 100_000, "[1]", '{"step": 1e999}'])
def test_an_invalid_description_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    """The checksum is right, so the file is whole, but this program did not write the description."""
    path = tmp_path / "x.safetensors"
    with monkeypatch.context() as context:
        context.setattr(checkpoint.json, "dumps", lambda *_, **__: text)
        checkpoint.save(path, DESCRIPTION, TENSORS)
    with pytest.raises(
        UserError, match=r"no JSON object: not a checkpoint|field method is missing, no str or out of range"
    ):
        checkpoint.load(path)


@pytest.mark.parametrize("version", ["0", "-1", "9" * 5000, "one", "١"])
def test_an_invalid_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    path = tmp_path / "x.safetensors"
    with monkeypatch.context() as context:
        context.setattr(checkpoint, "VERSION", version)
        checkpoint.save(path, DESCRIPTION, TENSORS)
    with pytest.raises(UserError, match=r"checkpoint version '.*, this program reads up to 1: update it"):
        checkpoint.load(path)


class Payload:
    """Makes a directory when unpickled."""

    def __init__(self, target: str) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (self.target,)


def test_a_pickle_is_never_executed(tmp_path: Path) -> None:
    path, proof = tmp_path / "evil.safetensors", tmp_path / "executed"
    path.write_bytes(pickle.dumps(Payload(str(proof))))
    with pytest.raises(UserError, match="not a readable checkpoint"):
        checkpoint.load(path)
    torch.save(Payload(str(proof)), path)
    with pytest.raises(UserError, match="not a readable checkpoint"):
        checkpoint.load(path)
    assert not proof.exists()


# ---- writing ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(
    saved: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as context:
        context.setattr(os, call, full)
        with pytest.raises(UserError, match=r"run\.safetensors: cannot be written: No space left on device"):
            checkpoint.save(saved, DESCRIPTION | {"step": 5}, TENSORS)
    assert_intact(saved)
    assert os.listdir(saved.parent) == [saved.name]


def test_an_interrupt_while_writing_leaves_the_old_file(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(os, "fsync", interrupted)
        with pytest.raises(KeyboardInterrupt):
            write_atomically(saved, "half")
    assert_intact(saved)
    assert os.listdir(saved.parent) == [saved.name]


def test_a_real_write_error_leaves_the_old_file(saved: Path) -> None:
    """The kernel refuses to let a file grow past a limit, as a full disk would."""
    code = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from nerf_core.common.files import write_atomically; from nerf_core.common.errors import UserError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: write_atomically(Path(sys.argv[1]), b'x' * 100000)\n"
        "except UserError as error: sys.stderr.write(str(error)); sys.exit(2)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(saved)], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "cannot be written: File too large" in done.stderr
    assert_intact(saved)
    assert os.listdir(saved.parent) == [saved.name]


@pytest.mark.parametrize("name", ["file/under/a/file.txt", "folder", "n" * 300])
def test_an_impossible_path_is_reported(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match=r"cannot be written: .+; choose a folder that has space and takes files"):
        write_atomically(tmp_path / name, "text")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


@pytest.mark.parametrize("name", ["", ".", "..", "/"])
def test_a_path_without_a_file_name_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="cannot be written: Is a directory"):
        write_atomically(Path(name), "text")
    assert not os.listdir(tmp_path)


def test_folders_are_made_and_text_is_utf8(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a" / "b" / "c.txt", "größer")
    assert (tmp_path / "a" / "b" / "c.txt").read_text(encoding="utf-8") == "größer"


SAVE_AND_DIE = """
import os, random, signal, sys, time
from pathlib import Path
import torch
from nerf_core.training import checkpoint
path, seed, tensors = Path(sys.argv[1]), int(sys.argv[2]), {"a": torch.ones(300_000)}
description = {"method": "nerf", "config": {}, "steps": 1, "seed": 0, "threads": 1, "step": 0, "seconds": 0.0,
               "scene": "", "scene_name": "", "scene_summary": "photos"}
checkpoint.save(path, description, tensors)
dice = random.Random(seed)
for _ in range(20):
    child = os.fork()
    if not child:
        while True:
            description["step"] += 1
            checkpoint.save(path, description, tensors)
    time.sleep(dice.uniform(0, 0.03))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    loaded, _ = checkpoint.load(path)
    description["step"] = loaded["step"]
print(description["step"])
"""


def test_a_save_killed_at_any_moment_leaves_a_loadable_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "run.safetensors"
    command = [sys.executable, "-c", SAVE_AND_DIE, str(path), str(random.Random(0).random())[2:9]]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 0  # some of the twenty processes saved before they were killed
    assert checkpoint.load(path)[0]["step"] == int(done.stdout)


# ---- a run folder -------------------------------------------------------------------------------------------------


def test_the_newest_intact_checkpoint_of_a_run_is_found(tmp_path: Path) -> None:
    for step in (5, 40, 300):
        checkpoint.save(step_path(tmp_path, step), DESCRIPTION | {"step": step}, TENSORS)
    path, description, _, rejected = newest(tmp_path)
    assert (path, description["step"], rejected) == (step_path(tmp_path, 300), 300, ())
    step_path(tmp_path, 300).write_bytes(b"")
    path, description, _, rejected = newest(tmp_path)
    assert (path, description["step"]) == (step_path(tmp_path, 40), 40)
    assert len(rejected) == 1
    assert "step_00000300.safetensors: not a readable checkpoint" in rejected[0]


def test_a_folder_that_is_no_run_is_reported(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"not a run that can be continued: no checkpoints/step_\*\.safetensors in it: train first"
    ):
        newest(tmp_path)
    step_path(tmp_path, 1).parent.mkdir()
    step_path(tmp_path, 1).write_bytes(b"junk")
    with pytest.raises(UserError, match=r"not a run that can be continued: .*not a readable checkpoint"):
        newest(tmp_path)


def test_older_checkpoints_are_deleted(tmp_path: Path) -> None:
    for step in (1, 2, 30):
        checkpoint.save(step_path(tmp_path, step), DESCRIPTION | {"step": step}, TENSORS)
    keep_newest(tmp_path)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == [
        "step_00000002.safetensors", "step_00000030.safetensors"
    ]  # fmt: skip


def test_steps_of_any_length_are_sorted_by_number(tmp_path: Path) -> None:
    run, steps = RunFolder(tmp_path), [99_999_998, 99_999_999, 100_000_000, 1_000_000_000]
    for step in steps:
        checkpoint.save(step_path(tmp_path, step), DESCRIPTION | {"step": step}, TENSORS)
    assert run.checkpoints() == [step_path(tmp_path, step) for step in steps]
    assert newest(tmp_path)[0] == step_path(tmp_path, steps[-1])
    keep_newest(tmp_path, 3)
    assert run.checkpoints() == [step_path(tmp_path, step) for step in steps[1:]]
    run.rewind(steps[1])
    assert run.checkpoints() == [step_path(tmp_path, steps[1])]


def test_finite_makes_json_of_anything_a_probe_holds() -> None:
    odd = {"a": np.array([1.0, np.nan]), "b": (np.float32(np.inf), np.int64(3)), "c": [None, "x", True, float("-inf")]}
    assert json.loads(json.dumps(finite(odd), allow_nan=False)) == {
        "a": [1.0, None], "b": [None, 3], "c": [None, "x", True, None]
    }  # fmt: skip
