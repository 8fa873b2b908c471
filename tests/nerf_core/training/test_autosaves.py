"""Autosaves are listed by their headers, continued with a picture, and cleared by their content."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_core.datasets import LoadOptions
from nerf_core.training import autosaves, checkpoint
from nerf_core.training.autosaves import any_autosave, clear, left_off, picture, small_picture, spare_files
from nerf_core.training.trainer import Trainer

Make = Callable[..., Trainer]
LOAD = LoadOptions(format="blender", downscale=2, background="white")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of autosaves of a user who has none, and the only one."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    return tmp_path / "data" / "nerf-viewer" / "autosave"


Save = Callable[..., Path]


@pytest.fixture
def save(folder: Path, make_trainer: Make, capture: Path) -> Save:
    """A function that writes autosaves. Each is an hour older than the one before."""
    trainer, written = make_trainer(), []

    def save_one(where: Path | None = capture, into: Path = folder, **changes: object) -> Path:
        file = into / spare_files(trainer.scene)[0].name.replace(f"-{os.getpid()}.", f"-{len(written)}.")
        description = {**trainer.describe(), **left_off(file, where, LOAD), **changes}
        picture = np.full((60, 80, 4), 40 + len(written), np.uint8)
        checkpoint.save(file, description, trainer.state() | small_picture(file, picture))
        os.utime(file, (1e9 - 3600 * len(written), 1e9 - 3600 * len(written)))
        written.append(file)
        return file

    return save_one


def test_autosaves_are_listed_with_what_continues_them(save: Save, capture: Path) -> None:
    assert not any_autosave()
    file, older = save(), save(None, step=7, seconds=2.5)
    assert any_autosave()
    first, second = autosaves.autosaves()
    assert (first.file, first.saved, first.bytes) == (file, 1e9, file.stat().st_size)
    assert (first.scene, first.method, first.step, first.capture, first.load) == ("ball", "nerf", 0, capture, LOAD)
    assert (second.file, second.step, second.seconds, second.capture) == (older, 7, 2.5, None)
    assert [first.problem, second.problem] == ["", ""]
    shown = picture(file)
    assert shown is not None
    assert (shown.shape, shown.dtype, np.unique(shown[..., :3]).tolist()) == ((60, 80, 4), np.uint8, [40])


def test_the_temporary_folder_is_looked_through_too(save: Save, tmp_path: Path) -> None:
    file = save(into=tmp_path / "temporary")
    assert [one.file for one in autosaves.autosaves()] == [file]


def test_only_headers_are_read(save: Save, monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(3):
        save()
    read = []
    real = autosaves.own_texts
    monkeypatch.setattr(autosaves, "own_texts", lambda file: (read.append(file), real(file))[1])
    assert any_autosave()
    assert len(read) == 1
    monkeypatch.setattr(checkpoint, "load", None)
    monkeypatch.setattr(autosaves, "tensor", None)
    assert len(autosaves.autosaves()) == 3


def test_a_picture_is_small_and_keeps_its_proportion() -> None:
    file, ramp = Path("ball-0123abcd-20260102-030405-6.safetensors"), np.zeros((900, 1600, 4), np.uint8)
    ramp[..., 0] = np.linspace(0, 255, 1600).round()
    (small,) = small_picture(file, ramp).values()
    assert (small.shape, small.dtype) == ((180, 320, 3), torch.uint8)
    assert abs(small[90, :, 0].numpy() - np.linspace(0, 255, 320)).max() < 2
    assert small_picture(file, np.zeros((1, 5000, 4), np.uint8))["picture"].shape == (1, 320, 3)
    assert small_picture(file, None) == {}


def test_the_users_own_files_hold_no_paths_of_this_computer(capture: Path) -> None:
    own = Path("mine.safetensors")
    assert left_off(own, capture, LOAD) == {}
    assert small_picture(own, np.zeros((4, 4, 4), np.uint8)) == {}


@pytest.mark.parametrize("damage", [None, torch.zeros(3, 3), torch.zeros(4, 4, 3), torch.zeros(0, 4, 3).byte(), "huge"])
def test_a_damaged_picture_is_none(damage: torch.Tensor | str | None, save: Save) -> None:
    file = save()
    description, tensors = checkpoint.load(file)
    tensors.pop("picture")
    if damage is not None:
        tensors["picture"] = torch.zeros(1, 4000, 3, dtype=torch.uint8) if isinstance(damage, str) else damage
    checkpoint.save(file, description, tensors)
    assert picture(file) is None
    assert [one.problem for one in autosaves.autosaves()] == [""]


def test_an_autosave_that_cannot_be_continued_says_why(save: Save, tmp_path: Path) -> None:
    gone = tmp_path / "gone \udcff"
    gone.mkdir()
    file = save(gone)
    gone.rmdir()
    save(left_off=5)
    save(left_off={"capture": None, "load": {"downscale": "two"}})
    unknown = save()
    description, tensors = checkpoint.load(unknown)
    checkpoint.save(unknown, {name: value for name, value in description.items() if name != "left_off"}, tensors)
    cut = save()
    cut.write_bytes(cut.read_bytes()[:-100])
    problems = {one.file: one.problem for one in autosaves.autosaves()}
    assert problems[file] == f"{tmp_path / 'gone'} \\xff is no longer there"
    assert [text for text in problems.values() if "was this written by another version" in text] != []
    assert problems[unknown] == "it does not say where its capture is: open that, then load this file"
    assert "cut short" in problems[cut]
    assert picture(cut) is None
    assert all(problems.values())


def test_clearing_deletes_only_what_this_program_wrote(save: Save, folder: Path, tmp_path: Path) -> None:
    written = [save() for _ in range(3)]
    cut, replaced = save(), save()
    cut.write_bytes(cut.read_bytes()[:-100])
    foreign = folder / written[0].name.replace("ball-", "other-").replace("-0.", "-9.")
    shutil.copy(written[0], foreign.with_name("mine.safetensors"))
    foreign.write_bytes(b"of another program")
    of_other = folder / written[0].name.replace(written[0].name.split("-")[1], "0" * 8)
    shutil.copy(written[0], of_other)  # a checkpoint, but not of the scene in its name
    listed = autosaves.autosaves()
    replaced.write_bytes(b"of another program, meanwhile")
    deleted, reasons = clear(listed)
    assert {one.file for one in deleted} == {*written, cut}
    assert not reasons
    assert set(folder.iterdir()) == {foreign, foreign.with_name("mine.safetensors"), of_other, replaced}
    assert clear(listed) == ([], [])


def test_a_file_that_cannot_be_deleted_is_told_of(save: Save, monkeypatch: pytest.MonkeyPatch) -> None:
    file = save()
    (one,) = autosaves.autosaves()

    def refuse(_: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "unlink", refuse)
    assert clear([one]) == ([], [f"{file}: cannot be deleted (Permission denied)"])


def test_a_description_of_any_kind_does_not_break_the_list(save: Save) -> None:
    """The texts of a header may be anything; a forger sets the checksum right."""
    file = save()
    (good,) = autosaves.autosaves()
    whole = file.read_bytes()
    length = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + length])
    for text in ("", "[]", "5", "{}", '{"scene": 3}', "[" * 100_000, json.dumps({"scene": "0"})):
        header["__metadata__"]["nerf"] = text
        encoded = json.dumps(header).encode()
        file.write_bytes(len(encoded).to_bytes(8, "little") + encoded + whole[8 + length :])
        assert autosaves.autosaves() == []
        assert clear([good]) == ([], [])
    for nonsense in ([], "text", {"capture": 5, "load": {}}, {"capture": "\0", "load": LOAD.__dict__}, {"load": None}):
        description = json.loads(json.loads(whole[8 : 8 + length])["__metadata__"]["nerf"])
        header["__metadata__"]["nerf"] = json.dumps(description | {"left_off": nonsense})
        encoded = json.dumps(header).encode()
        file.write_bytes(len(encoded).to_bytes(8, "little") + encoded + whole[8 + length :])
        (one,) = autosaves.autosaves()
        assert one.problem
