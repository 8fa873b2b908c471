"""The worker saves what is not saved yet: where it can, over nothing, and only what it names."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from desk import Desk

from nerf_core.live import run
from nerf_core.live.messages import CancelLoading, InOrder, OpenScene, Reset, SaveCheckpoint, SaveUnsaved, UseMethod
from nerf_core.training import autosaves, checkpoint
from nerf_core.training.trainer import Trainer

OpenDesk = Callable[..., Desk]


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the autosaves of a user who has none."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    return tmp_path / "data" / "nerf-viewer" / "autosave"


def hold(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Return two events: the next model waits to be made until the first is set, and sets the second when it does."""
    go_on, waits = threading.Event(), threading.Event()

    def slow(*given: object) -> Trainer:
        waits.set()
        assert go_on.wait(60)
        return Trainer(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(run, "Trainer", slow)
    return go_on, waits


def steps(folder: Path) -> dict[str, int]:
    return {file.name: checkpoint.describe(file)["step"] for file in folder.glob("*.safetensors")}


def test_save_and_start_again_answered_twice_saves_once(open_desk: OpenDesk, data: Path, tmp_path: Path) -> None:
    """The second answer, given while the first save ran, once replaced the trained model with an untrained one."""
    desk, own = open_desk(), tmp_path / "own"
    desk.trained(3)
    both = InOrder((SaveUnsaved(folder=own), Reset()))
    desk.send(both, both)
    desk.until_told("saved step 3")
    desk.until(lambda s: s.step == 0 and s.status == "ready")
    assert steps(own) == {"ball0.safetensors": 3}
    desk.trained(2)
    desk.send(both)
    desk.until_told("saved step 2")
    assert steps(own) == {"ball0.safetensors": 3, "ball0-2.safetensors": 2}
    assert not data.exists()


def test_unsaved_steps_go_to_the_next_place_that_takes_them(open_desk: OpenDesk, data: Path, tmp_path: Path) -> None:
    desk = open_desk()
    desk.trained(3)
    desk.send(InOrder((SaveUnsaved(folder=Path("/proc/none")), Reset())))
    assert desk.until_told("saved step 3").path == next(data.iterdir())
    assert "/proc/none/ball0.safetensors" in desk.until_told("cannot be written").text
    desk.until(lambda s: s.step == 0)
    desk.trained(2)
    desk.send(SaveUnsaved(tmp_path / "asked.safetensors"), SaveUnsaved(tmp_path / "again.safetensors"))
    desk.until_told("saved step 2")
    desk.trained(1)
    assert steps(tmp_path) == {"asked.safetensors": 2}


def test_steps_whose_file_was_deleted_are_unsaved(open_desk: OpenDesk, data: Path, tmp_path: Path) -> None:
    """As after "Clear…", or after another window has written three newer autosaves of the scene."""
    desk = open_desk()
    desk.trained(3)
    desk.send(SaveUnsaved())
    desk.until_told("saved step 3")
    (one,) = autosaves.autosaves()
    desk.send(OpenScene(one.capture, desk.settings, checkpoint=one.file))
    assert desk.until(lambda s: s.loaded == 2).saved_step == 3
    autosaves.clear([one])
    assert desk.until(lambda s: s.saved_step == 0).step == 3
    desk.send(SaveUnsaved())
    desk.until(lambda s: s.saved_step == 3)
    assert list(steps(data).values()) == [3]


def test_an_autosave_is_written_after_the_current_folder_has_gone(
    open_desk: OpenDesk, data: Path, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "link").symlink_to(capture)
    monkeypatch.chdir(tmp_path / "here")
    desk = open_desk(opened=False)
    desk.send(OpenScene(Path("link"), desk.settings))
    desk.until(lambda s: s.status == "ready")
    desk.trained(2)
    (tmp_path / "here" / "link").unlink()
    os.rmdir(tmp_path / "here")
    desk.send(SaveUnsaved())
    desk.until_told("saved step 2")
    (one,) = autosaves.autosaves()
    assert one.capture == tmp_path / "here" / "link"
    desk.send(OpenScene(Path("link"), desk.settings))
    assert "the current folder was deleted" in desk.until_told("link: ").text


@pytest.mark.parametrize("change", ["scene", "method"])
def test_loading_can_be_cancelled_until_the_model_is_made(
    change: str, open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = open_desk()
    before = desk.trained(3)
    go_on, waits = hold(monkeypatch)
    desk.send(OpenScene(None, desk.settings) if change == "scene" else UseMethod("voxels"))
    assert waits.wait(60)
    desk.send(CancelLoading())
    go_on.set()
    desk.until_told("loading was cancelled")
    after = desk.until(lambda s: s.status == "paused")
    assert (after.scene, after.method, after.step, after.loaded) == (before.scene, before.method, 3, 1)


def test_a_last_save_is_named_after_the_scene_that_it_holds(
    open_desk: OpenDesk, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A window that closes while another scene opens saves the one that is open, whichever that is then."""
    desk = open_desk()
    desk.trained(3)
    go_on, waits = hold(monkeypatch)
    desk.send(OpenScene(None, desk.settings))
    assert waits.wait(60)
    desk.send(SaveUnsaved())  # as the session does
    threading.Timer(0.2, go_on.set).start()
    assert desk.worker.stop(60)
    (file,) = data.iterdir()
    assert file.name.startswith("ball0-")
    assert checkpoint.describe(file)["scene_name"] == "ball0"
    assert steps(data) == {file.name: 3}


def test_a_file_that_is_saved_twice_is_replaced(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk, file = open_desk(), tmp_path / "own.safetensors"
    desk.trained(1)
    desk.send(SaveCheckpoint(file))
    desk.trained(1)
    desk.send(SaveCheckpoint(file))
    desk.until_told("saved step 2")
    assert steps(tmp_path) == {"own.safetensors": 2}
