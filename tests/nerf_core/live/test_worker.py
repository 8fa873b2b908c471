"""The worker's real thread on a tiny scene: its states, checkpoints, failures and end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from desk import PATIENCE, Desk, orbit, view_of

from nerf_core.datasets import LoadOptions
from nerf_core.live import mailbox
from nerf_core.live.messages import (
    FIRST_RUN,
    CancelLoading,
    Command,
    InOrder,
    Inspect,
    LoadCheckpoint,
    OpenScene,
    Pause,
    Reset,
    SaveCheckpoint,
    StartExport,
    Train,
    UseMethod,
)
from nerf_core.live.worker import Worker
from nerf_core.rendering.export.requests import ExportPath
from nerf_core.training import checkpoint
from nerf_core.training.settings import RunSettings

OpenDesk = Callable[..., Desk]


def test_the_states_from_empty_to_finished(open_desk: OpenDesk, capture: Path) -> None:
    desk = open_desk(opened=False, steps=20)
    assert desk.worker.snapshot().status == "empty"
    desk.send(OpenScene(capture, desk.settings))
    shown = desk.until(lambda s: s.status == "ready")
    assert shown.scene is not None
    assert (shown.scene.format, shown.loaded, shown.step, shown.total_steps) == ("blender", 1, 0, 20)
    desk.send(Train())
    desk.until(lambda s: s.status == "training" and s.step >= 3)
    desk.send(Pause())
    paused = desk.until(lambda s: s.status == "paused")
    time.sleep(0.05)
    assert desk.worker.snapshot().step == paused.step
    assert paused.history.step.tolist() == list(range(1, paused.step + 1))
    assert paused.seconds > 0
    desk.send(Reset())
    desk.until(lambda s: s.status == "ready" and s.step == 0 and len(s.history.step) == 0)
    assert desk.trained(3).status == "paused"
    assert desk.trained(20 - 3).status == "finished"
    desk.send(Train())
    assert desk.until_told("all 20 steps of the schedule are done").level == "info"


def test_save_load_and_go_on(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk, a, b = open_desk(), tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    desk.trained(3)
    desk.send(SaveCheckpoint(a))
    assert desk.until_told(f"saved step 3 to {a}").path == a
    desk.trained(2)
    desk.send(LoadCheckpoint(a))
    assert desk.until_told("loaded a.safetensors: step 3").level == "info"
    desk.until(lambda s: s.step == 3 and s.status == "paused")
    desk.send(SaveCheckpoint(b))
    desk.until_told(f"saved step 3 to {b}")
    (description_a, state_a), (description_b, state_b) = checkpoint.load(a), checkpoint.load(b)
    assert description_a == description_b
    assert [name for name in state_a if not torch.equal(state_a[name], state_b[name])] == []


def test_a_capture_opens_with_its_model_or_not_at_all(open_desk: OpenDesk, capture: Path, tmp_path: Path) -> None:
    desk, file = open_desk(), tmp_path / "ball-0123abcd-20260102-030405-1.safetensors"  # as an autosave is called
    desk.trained(3)
    desk.worker.request_view(view_of(desk.worker.snapshot().scene, 1))
    desk.until(lambda s: s.preview is not None and s.preview.stride == 1 and s.preview.step == 3)
    desk.send(SaveCheckpoint(file), SaveCheckpoint(tmp_path / "own.safetensors"))
    desk.until_told(f"saved step 3 to {tmp_path / 'own'}")
    description, tensors = checkpoint.load(file)
    assert description["left_off"] == {"capture": str(capture), "load": asdict(desk.settings.load)}
    assert tensors["picture"].shape == (13, 13, 3)
    own, tensors = checkpoint.load(tmp_path / "own.safetensors")
    assert ("left_off" in own, "picture" in tensors) == (False, False)
    desk.trained(1)
    number, *_ = desk.send(OpenScene(None, replace(desk.settings, load=LoadOptions(downscale=9)), checkpoint=file))
    assert "trained on " in desk.until_answered(number).text
    shown = desk.worker.snapshot()
    assert shown.scene is not None
    assert (shown.scene.name, shown.step, shown.loaded) == (capture.name, 4, 1)
    desk.send(OpenScene(capture, desk.settings, checkpoint=file))
    shown = desk.until(lambda s: s.loaded == 2)
    assert (shown.step, shown.saved_step, shown.status) == (3, 3, "paused")
    assert desk.until_told(f"loaded {file.name}: step 3").kind == "loaded"
    desk.send(OpenScene(tmp_path / "moved", desk.settings, checkpoint=file))
    desk.until_told(f"{tmp_path / 'moved'} does not exist: name the folder of a dataset; then load {file}")
    desk.send(OpenScene(capture, desk.settings, checkpoint=tmp_path / "none.safetensors"))
    desk.until_told("none.safetensors: no such checkpoint")
    assert desk.worker.snapshot().step == 3


def test_a_failed_load_leaves_the_model(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk, path = open_desk(), tmp_path / "x.safetensors"
    desk.trained(2)
    desk.send(LoadCheckpoint(tmp_path / "none.safetensors"))
    desk.until_told("none.safetensors: no such checkpoint")
    desk.send(SaveCheckpoint(path))
    desk.until_told("saved step 2")
    description, state = checkpoint.load(path)
    checkpoint.save(path, description | {"scene": "another", "scene_name": "elsewhere"}, state)
    desk.send(LoadCheckpoint(path))
    desk.until_told("trained on 'elsewhere', whose photos, poses or bounds differ from ball0's: open that one")
    other = {"scene": "another", "scene_summary": "photos of 8×8 pixels"}
    checkpoint.save(path, description | other, state)
    desk.send(LoadCheckpoint(path))
    desk.until_told("trained on 'ball0', 'photos of 8×8 pixels'; open now is ball0, 'photos of 16×16 pixels (5 train")
    desk.until_told("open it as it was then (--downscale, --max-size, --format, …)")
    assert desk.trained(1).step == 3


def test_a_wrong_path_leaves_the_scene_alive(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    desk.trained(1)
    desk.send(OpenScene(tmp_path / "nowhere", desk.settings))
    assert desk.until_told("nowhere").level == "error"
    shown = desk.until(lambda s: s.loading == "" and s.status == "paused")
    assert (shown.loaded, shown.step) == (1, 1)
    assert desk.trained(1).step == 2


def test_in_order_stops_at_the_first_failure(open_desk: OpenDesk, capture: Path, tmp_path: Path) -> None:
    desk = open_desk()
    before = desk.trained(3)
    opening = OpenScene(capture, desk.settings)
    desk.send(InOrder((SaveCheckpoint(Path("/proc/none/a.safetensors")), opening)))
    desk.until_told("/proc/none/a.safetensors")
    desk.send(Train(1))
    assert desk.until(lambda s: s.step == 4 and s.status != "training").loaded == before.loaded
    desk.send(InOrder((SaveCheckpoint(tmp_path / "a.safetensors"), opening)))
    assert desk.until(lambda s: s.loaded == before.loaded + 1).step == 0
    assert checkpoint.describe(tmp_path / "a.safetensors")["step"] == 4


def test_a_model_that_does_not_fit_names_its_file(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk()
    desk.trained(1)
    desk.send(SaveCheckpoint(tmp_path / "a.safetensors"))
    desk.until_told("saved step 1")
    description, state = checkpoint.load(tmp_path / "a.safetensors")
    checkpoint.save(tmp_path / "b.safetensors", description | {"method": "magic"}, state)
    checkpoint.save(tmp_path / "c.safetensors", description, {})
    for name, words in {"b": "unknown method 'magic'", "c": "the checkpoint does not fit method"}.items():
        desk.send(LoadCheckpoint(tmp_path / f"{name}.safetensors"))
        assert desk.until_told(words).text.startswith(f"{tmp_path / name}.safetensors: {words}")


def test_another_method_begins_anew_on_the_same_scene(open_desk: OpenDesk) -> None:
    desk = open_desk()
    scene = desk.trained(2).scene
    desk.send(UseMethod("voxels"))
    begun = desk.until(lambda s: s.method == "voxels" and s.status == "ready")
    assert begun.step == 0
    assert begun.scene is scene
    assert desk.trained(3).step == 3
    for refused, words in (
        (UseMethod("wings"), "unknown method 'wings'"),
        (UseMethod("voxels", changes={"x": "1"}), "has no such"),
    ):
        desk.send(refused)
        desk.until_told(words)
        assert desk.worker.snapshot().method == "voxels"
        assert desk.worker.snapshot().step == 3
    desk.send(UseMethod("voxels", changes={"prune_every": "40"}))
    desk.until(lambda s: s.config["prune_every"] == 40)


@pytest.mark.parametrize("command", [Train(), Reset(), SaveCheckpoint(Path("x")), LoadCheckpoint(Path("x"))])
def test_without_a_scene_commands_say_so(open_desk: OpenDesk, command: Command) -> None:
    desk = open_desk(opened=False)
    desk.send(command)
    desk.until(lambda _: len(desk.heard) == 1)
    assert desk.heard[0].text.startswith(("no scene is open: open one first", "x: no such checkpoint"))


def test_a_state_that_cannot_be_read_is_reported_once_and_the_thread_lives(
    open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = open_desk()

    def lost(device: object) -> int:
        raise OSError("the device is lost")

    with monkeypatch.context() as context:
        context.setattr("nerf_core.live.snapshot.memory_held", lost)
        desk.send(Train())
        assert desk.until_told("the state of the run cannot be read: OSError: the device is lost").level == "error"
        desk.until(lambda s: s.status == "failed")
        time.sleep(0.6)  # two of the worker's idle turns
        desk.until(lambda _: True)
        assert len(desk.heard) == 1
    desk.trained(1)


def test_an_exception_is_reported_once_and_the_thread_lives(
    open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def boom(*_: object) -> None:
        raise RuntimeError("boom\nand more")

    desk = open_desk()
    scene = desk.worker.snapshot().scene
    with monkeypatch.context() as context:
        context.setattr("nerf_core.live.artist.view_rays", boom)
        desk.worker.request_view(view_of(scene, 1))
        notice = desk.until_told("the worker failed: RuntimeError: boom")
        assert notice.detail.startswith("Traceback")
        assert "\n" not in notice.text
        desk.until(lambda s: s.status == "failed")
        time.sleep(0.6)  # two of the worker's idle turns
        desk.until(lambda _: True)
        assert len(desk.heard) == 1
    desk.trained(1)  # the same view is tried again once there is something new to show
    desk.until(lambda s: s.preview is not None and s.preview.stamp == 1)
    desk.worker.request_view(view_of(scene, 2))
    desk.until(lambda s: s.preview is not None and s.preview.stamp == 2)
    assert desk.trained(1).status == "paused"


def test_a_nan_loss_goes_back_to_good_weights(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk = open_desk(learning_rate="1e38")
    for _ in range(2):  # twice: further training must not change the state to go back to
        desk.heard.clear()
        desk.send(Train())
        assert desk.until_told("the loss is nan; lower the learning rate").text.endswith("back at step 0, paused")
        desk.until(lambda s: s.status == "failed" and s.step == 0)
    desk.send(SaveCheckpoint(tmp_path / "good.safetensors"))
    desk.until_told("saved step 0")
    state = checkpoint.load(tmp_path / "good.safetensors")[1]
    assert all(value.isfinite().all() for value in state.values())


def test_closing_ends_everything_and_keeps_what_was_asked_before(open_desk: OpenDesk, tmp_path: Path) -> None:
    desk, path = open_desk(), tmp_path / "last.safetensors"
    desk.send(Train(), StartExport(ExportPath(orbit(desk.worker.snapshot().scene, 5000), 30.0, tmp_path / "long.mp4")))
    desk.until(lambda s: s.step > 1 and s.export is not None)
    desk.send(SaveCheckpoint(path))
    assert desk.worker.stop(PATIENCE)
    assert not desk.worker.alive
    assert list(tmp_path.iterdir()) == [path]
    assert checkpoint.load(path)[0]["step"] == desk.worker.snapshot().step


def test_training_waits_for_a_frame_but_not_for_a_window_that_hangs(
    open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = open_desk()
    monkeypatch.setattr(mailbox, "FRAME_SECONDS", PATIENCE)
    desk.send(Train())
    desk.until(lambda s: s.step >= 2)
    desk.worker.paints()
    time.sleep(0.2)  # the step in work goes on to the next point where it may wait
    waiting = desk.worker.snapshot().step
    time.sleep(0.2)
    assert desk.worker.snapshot().step == waiting
    monkeypatch.setattr(mailbox, "FRAME_SECONDS", 0.02)
    desk.worker.painted(0.4)
    desk.until(lambda s: s.step > waiting + 2)
    desk.worker.paints()  # and no `painted`
    step = desk.worker.snapshot().step
    desk.until(lambda s: s.step > step + 5)


def test_training_waits_for_the_frame_that_a_served_picture_brings(
    open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A chunk that began between the picture and its frame would take the cores away from the frame."""
    desk, waits = open_desk(), list[bool]()
    let_paint = mailbox.Mailbox.let_paint

    def noted(mail: mailbox.Mailbox, soon: bool = False) -> None:
        waits.append(soon)
        let_paint(mail, soon)

    monkeypatch.setattr(mailbox.Mailbox, "let_paint", noted)
    desk.send(Train())
    desk.until(lambda s: s.step >= 2)
    assert True not in waits
    desk.worker.request_view(view_of(desk.worker.snapshot().scene, 1, moving=True))
    desk.until(lambda s: s.preview is not None and s.preview.stamp == 1)
    desk.until(lambda s: True in waits)
    desk.worker.request_view(view_of(desk.worker.snapshot().scene, 2))
    rests = desk.until(lambda s: s.preview is not None and s.preview.stamp == 2 and s.preview.complete).step
    desk.until(lambda s: s.step > rests)
    waits.clear()
    desk.until(lambda s: s.step > rests + 3)
    assert False in waits
    assert True not in waits  # nobody waits for what follows
    desk.send(Inspect(view_of(desk.worker.snapshot().scene, 2).camera, (1, 1)))
    desk.until(lambda s: True in waits)


def test_a_frame_that_is_about_to_begin_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mailbox, "SOON_SECONDS", 5.0)
    monkeypatch.setattr(mailbox, "FRAME_SECONDS", PATIENCE)
    mail, done = mailbox.Mailbox(lambda: None, 0.6), list[str]()

    def window() -> None:
        time.sleep(0.05)
        done.append("begins")
        mail.paints()
        time.sleep(0.05)
        done.append("ends")
        mail.painted(0.05)

    def seconds(soon: bool) -> float:
        begin = time.monotonic()
        mail.let_paint(soon)
        return time.monotonic() - begin

    for k in range(2):  # the second frame is waited for like the first
        drawing = threading.Thread(target=window)
        drawing.start()
        mail.let_paint(soon=True)
        assert done == ["begins", "ends"] * (k + 1)
        drawing.join()
    assert seconds(soon=False) < 1
    monkeypatch.setattr(mailbox, "SOON_SECONDS", 0.05)
    assert 0.05 <= seconds(soon=True) < 1  # no frame comes
    monkeypatch.setattr(mailbox, "FRAME_SECONDS", 0.02)
    mail.paints()  # and no `painted`
    assert 0.02 <= seconds(soon=False) < 1
    assert 0.05 <= seconds(soon=True) < 1  # the frame that hangs is forgotten, the next one is waited for


def test_the_worker_calls_wake(tiny: RunSettings, capture: Path) -> None:
    calls: list[Any] = []
    worker = Worker(tiny, wake=lambda: calls.append(1))
    worker.start()
    worker.send(OpenScene(capture, tiny))
    end = time.monotonic() + PATIENCE
    while worker.snapshot().status != "ready" and time.monotonic() < end:
        time.sleep(0.01)
    assert worker.stop(PATIENCE)
    assert calls


def test_closing_while_a_scene_loads_is_no_failure(open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch) -> None:
    desk = open_desk(opened=False)

    def slow(path: object, options: object, progress: Callable[[str, int, int], None], *_: object) -> None:
        for done in range(100_000):
            time.sleep(0.01)
            progress("loading photos", done, 100_000)

    monkeypatch.setattr("nerf_core.live.run.open_capture", slow)
    desk.send(OpenScene(None, desk.settings))
    desk.until(lambda s: s.status == "loading")
    assert desk.worker.stop(PATIENCE)
    assert desk.worker.notices() == []


def test_loading_can_be_cancelled_and_leaves_what_is_open(
    open_desk: OpenDesk, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = open_desk()
    before = desk.trained(2)

    def slow(path: object, options: object, progress: Callable[[str, int, int], None], *_: object) -> None:
        for done in range(100_000):
            time.sleep(0.01)
            progress("loading photos", done, 100_000)

    with monkeypatch.context() as patch:
        patch.setattr("nerf_core.live.run.open_capture", slow)
        desk.send(OpenScene(None, desk.settings))
        desk.until(lambda s: s.loading.startswith("loading photos"))
        desk.send(CancelLoading())
        assert desk.until_told("cancelled").level == "info"
    after = desk.until(lambda s: s.status == "paused")
    assert (after.scene, after.step, after.loaded) == (before.scene, before.step, before.loaded)
    desk.send(OpenScene(capture, desk.settings))  # what is sent after the cancelling is not cancelled
    assert desk.until(lambda s: s.loaded == before.loaded + 1).step == 0


def test_training_for_nothing_is_refused(open_desk: OpenDesk) -> None:
    desk = open_desk()
    desk.send(Train(), Train(steps=0), Train(seconds=0.0))
    assert desk.until_told("training for 0 steps: give at least 1").kind == "failed"
    assert desk.until_told("training for 0 seconds: give more than 0").kind == "failed"
    assert desk.worker.snapshot().status in ("training", "finished")  # as it was before


def test_the_time_left_is_not_longer_than_what_was_asked_for(open_desk: OpenDesk) -> None:
    desk = open_desk(steps=1_000_000)
    desk.send(Train(seconds=200.0))
    left = desk.until(lambda s: s.seconds_left is not None).seconds_left
    assert left is not None
    assert 0 < left <= 200


def test_no_time_left_is_shown_unless_an_end_was_asked_for(open_desk: OpenDesk) -> None:
    desk = open_desk(steps=1_000_000)
    desk.send(Train())
    shown = desk.until(lambda s: s.status == "training" and s.rays_per_second > 0 and s.step > 3)
    assert shown.seconds_left is None
    desk.send(Pause(), Train(steps=100_000))
    assert desk.until(lambda s: s.seconds_left is not None)


def test_training_gives_its_memory_back_when_it_pauses_and_when_it_is_done(
    open_desk: OpenDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk, rests = open_desk(steps=1_000_000), list[int]()
    trainer = desk.worker._runs[FIRST_RUN].need_trainer()
    monkeypatch.setattr(trainer.method, "rest", lambda: rests.append(trainer.step_count))
    desk.send(Train())
    desk.until(lambda s: s.step >= 3)
    desk.send(Pause())
    paused = desk.until(lambda s: s.status == "paused")
    assert rests == [paused.step]
    desk.trained(2)
    assert rests == [paused.step, paused.step + 2]


def test_an_installation_that_cannot_train_is_told_of(tiny: RunSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_worker: Worker, _number: int) -> None:
        raise ImportError("no torch here")

    monkeypatch.setattr(Worker, "_new_run", broken)
    desk = Desk(tiny, None)
    notice = desk.until_told("the worker failed: ImportError: no torch here")
    assert (notice.level, notice.kind) == ("error", "failed")
    assert desk.worker.snapshot().status == "failed"
    assert desk.worker.stop()
