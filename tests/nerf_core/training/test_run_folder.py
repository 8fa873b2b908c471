"""What a run folder holds, who may write to it, and the errors of a broken one."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from nerf_core.common.errors import UserError
from nerf_core.common.files import PREFIX, SUFFIX, Part
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.training import checkpoint
from nerf_core.training.loop import Goal, train_run
from nerf_core.training.run_folder import RunFolder, must_agree
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer


@pytest.fixture
def run(tmp_path: Path, capture: Path, tiny: RunSettings) -> Iterator[RunFolder]:
    """A run of two steps with a checkpoint after each."""
    folder = RunFolder(tmp_path / "run")
    with folder.claimed():
        trainer = Trainer(load_scene(capture, tiny.load), tiny)
        folder.begin(capture, tiny, trainer)
        train_run(folder, trainer, Goal(2), save_every=1e-9)
        yield folder


def error_of(action: Callable[[], object]) -> str:
    with pytest.raises(UserError) as caught:
        action()
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_config_comes_back(run: RunFolder, capture: Path, tiny: RunSettings) -> None:
    assert run.config() == (capture.resolve(), tiny)
    config = json.loads(run.config_file.read_text(encoding="utf-8"))
    assert config["method"]["width"] == 32
    assert {"python", "torch", "numpy"} <= set(config["versions"])
    assert config["device"].startswith("CPU")


def test_restore_gives_the_newest_step(run: RunFolder) -> None:
    trainer, notes = run.restore()
    assert (trainer.step_count, notes) == (2, ())
    assert trainer.seconds > 0


def test_a_damaged_checkpoint_is_skipped_for_the_one_before(run: RunFolder) -> None:
    newest = run.checkpoints()[-1]
    data = bytearray(newest.read_bytes())
    data[-5] ^= 1
    newest.write_bytes(data)
    trainer, notes = run.restore()
    assert trainer.step_count == 1
    assert len(notes) == 1
    assert f"{newest}: damaged" in notes[0]
    run.rewind(1)
    assert [p.name for p in run.checkpoints()] == ["step_00000001.safetensors"]
    assert newest.with_name(f"{newest.name}.damaged").exists()


def test_rewind_forgets_what_was_logged_later(run: RunFolder) -> None:
    whole = [json.dumps({"step": k, "loss": 0.1}) + "\n" for k in (1, 2, 3)]
    run.log_file.write_text("".join(whole) + '{"step": 2, "lo', encoding="utf-8")
    run.rewind(2)
    assert run.log_file.read_text(encoding="utf-8") == "".join(whole[:2])


def test_one_process_at_a_time(run: RunFolder) -> None:
    def claim() -> None:
        with RunFolder(run.path).claimed():
            pass

    assert error_of(claim) == f"{run.path}: another process trains in this folder: wait for it or choose another --out"


def test_a_folder_that_cannot_be_made_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()

    def claim(path: Path) -> Callable[[], None]:
        def action() -> None:
            with RunFolder(path).claimed():
                pass

        return action

    assert "cannot be written (Not a directory)" in error_of(claim(tmp_path / "file" / "run"))
    assert "cannot be written" in error_of(claim(Path("/proc/run")))


def test_a_new_folder_is_removed_if_the_run_fails_at_once(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), RunFolder(tmp_path / "new").claimed():
        raise RuntimeError
    (tmp_path / "old").mkdir()
    with pytest.raises(RuntimeError), RunFolder(tmp_path / "old").claimed():
        raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["old"]


def test_a_new_run_overwrites_nothing(run: RunFolder, tmp_path: Path) -> None:
    assert "holds a run already: continue it with --resume" in error_of(run.must_be_new)
    foreign = RunFolder(tmp_path)
    foreign.config_file.write_text('{"editor": {}}', encoding="utf-8")
    assert "not written by a training" in error_of(foreign.must_be_new)


def test_leftovers_of_a_killed_save_are_removed(run: RunFolder, tmp_path: Path) -> None:
    """A part that nobody locks is left over. One that is being written stays, and so does a foreign file."""
    other = RunFolder(tmp_path / "other")
    with other.claimed():
        (other.path / "config.json").touch()
    folder = other.path / "checkpoints"
    left, foreign = folder / f"{PREFIX}abc{SUFFIX}", folder / ".download.part"
    left.write_bytes(b"half")
    foreign.write_bytes(b"half")
    (folder / f"{PREFIX}frames{SUFFIX}").mkdir()
    (folder / f"{PREFIX}frames{SUFFIX}" / "00000.png").touch()
    part = Part(folder)
    part.path.write_bytes(b"at work")
    with other.claimed():
        assert sorted(folder.iterdir()) == sorted([foreign, part.path])
    part.release()
    assert list(folder.iterdir()) == [foreign]


def test_foreign_files_among_the_checkpoints_are_left_alone(run: RunFolder) -> None:
    """They are not deleted as old ones, not loaded as the newest one, and not renamed as damaged ones."""
    own = run.checkpoints()
    folder = own[0].parent
    foreign = [folder / name for name in ("zz_copy.safetensors", "best.safetensors", "step_5.safetensors")]
    foreign[0].write_bytes(own[0].read_bytes())
    foreign[1].write_bytes(b"of another program")
    foreign[2].write_bytes(b"not our spelling")
    trainer, notes = run.restore()
    assert (trainer.step_count, notes) == (2, ())
    run.rewind(2)
    for _ in range(3):
        trainer.step()
        run.save(trainer.describe(), trainer.state())
    assert [checkpoint.step_of(path) for path in run.checkpoints()] == [4, 5]
    assert all(path.exists() for path in foreign)


def test_a_checkpoint_of_another_step_is_not_deleted(run: RunFolder) -> None:
    older = checkpoint.step_path(run.path, 0)
    older.write_bytes(run.checkpoints()[0].read_bytes())  # the user's copy
    checkpoint.keep_newest(run.path, 1)
    assert [checkpoint.step_of(path) for path in run.checkpoints()] == [0, 2]


def test_a_checkpoint_of_a_newer_version_stops_the_run_and_stays(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    description, state = checkpoint.load(run.checkpoints()[-1])
    newer = checkpoint.step_path(run.path, 9)
    with monkeypatch.context() as context:
        context.setattr(checkpoint, "VERSION", checkpoint.VERSION + 1)
        checkpoint.save(newer, description | {"step": 9}, state)
    text = error_of(run.restore)
    assert f"{newer}: checkpoint version '2', this program reads up to 1: update it; or move it away" in text
    assert newer.exists()


def test_a_foreign_log_is_not_replaced(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "server")
    run.path.mkdir()
    run.log_file.write_text("GET /index.html\n", encoding="utf-8")
    with run.claimed():
        assert error_of(run.must_be_new) == f"{run.log_file}: not written by a training: choose another --out"


@pytest.mark.parametrize("name", ["metrics.json", "eval", "config.json"])
def test_foreign_files_with_a_runs_names_are_refused(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_text('{"settings": {"editor": "vi"}}', encoding="utf-8")
    assert error_of(RunFolder(tmp_path).must_be_new) == f"{file}: not written by a training: choose another --out"


def test_a_foreign_file_named_as_a_checkpoint_is_neither_renamed_nor_taken_for_one(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    foreign = checkpoint.step_path(run.path, 3)
    foreign.write_bytes(b"of another program")
    trainer, notes = run.restore()
    assert (trainer.step_count, len(notes)) == (2, 1)
    run.rewind(2)
    warnings: list[str] = []
    train_run(run, trainer, Goal(3), warn=warnings.append)
    assert foreign.read_bytes() == b"of another program"
    assert f"{foreign}: not a checkpoint of its step, and not replaced: move it away" in warnings
    assert "step 3 is saved to " in warnings[-1]


def test_an_own_checkpoint_that_is_cut_short_is_renamed_and_replaces_nothing(run: RunFolder) -> None:
    newest = run.checkpoints()[-1]
    newest.write_bytes(newest.read_bytes()[:-100])
    other = newest.with_name(f"{newest.name}.damaged")
    other.write_bytes(b"an earlier one")
    assert run.restore()[0].step_count == 1
    run.rewind(1)
    assert not newest.exists()
    assert other.read_bytes() == b"an earlier one"
    assert newest.with_name(f"{newest.name}.damaged-2").exists()


@pytest.mark.parametrize(
    "damage",
    [b"\xff\xfe", b"[" * 100_000, b'{"step": "two"}', b'{"step": null}', b"[1]", b"{}", b"\0" * 50, b'{"step": [1]}'],
    ids=["bytes", "depth", "text", "null", "list", "empty", "zeros", "nested"],
)
def test_a_damaged_log_stops_no_run(run: RunFolder, damage: bytes) -> None:
    line = b'{"step": 1}\n'
    whole = line + damage + b"\n" + line
    run.log_file.write_bytes(whole)
    (note,) = run.rewind(2)
    assert note == f"{run.log_file}: 1 of 3 lines cannot be read; it is kept as log.jsonl.damaged"
    run.log_file.write_bytes(damage + b"\n")
    assert run.rewind(2)[0].endswith("it is kept as log.jsonl.damaged-2")
    run.log_file.write_bytes(2 * line)
    assert run.log_file.read_bytes() == 2 * line
    assert run.log_file.with_name("log.jsonl.damaged").read_bytes() == whole


def test_a_log_that_is_a_folder_stops_no_run(run: RunFolder) -> None:
    run.log_file.unlink()
    run.log_file.mkdir()
    (note,) = run.rewind(2)
    assert "training goes on without it" in note


def test_mutated_logs_stop_no_run(run: RunFolder) -> None:
    whole = b"".join(json.dumps({"step": k, "loss": 0.1, "psnr": 10.0}).encode() + b"\n" for k in range(20))
    dice = random.Random(0)
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(dice.randint(1, 5)):
            data[dice.randrange(len(data))] = dice.randrange(256)
        run.log_file.write_bytes(data[: dice.randint(0, len(data))])
        run.rewind(10)
        assert all(json.loads(line)["step"] <= 10 for line in run.log_file.read_bytes().splitlines())


def broken(change: Callable[[dict[str, Any]], object]) -> Callable[[str], str]:
    def apply(text: str) -> str:
        config = json.loads(text)
        change(config)
        return json.dumps(config)

    return apply


@pytest.mark.parametrize(
    ("breaking", "said"),
    [
        (lambda text: "", "config.json"),
        (lambda text: text[:50], "breaks off or is no JSON"),
        (lambda text: "[" * 200_000, "config.json"),
        (broken(lambda c: c.pop("settings")), "settings is None: an object is needed"),
        (broken(lambda c: c["settings"].pop("load")), "settings.load is None: an object is needed"),
        (broken(lambda c: c["settings"].pop("seed")), "settings.seed is None: a int is needed"),
        (broken(lambda c: c["settings"].update(steps="9")), "settings.steps is '9': a int is needed"),
        (broken(lambda c: c["settings"]["load"].update(downscale=0.5)), "settings.load.downscale is 0.5"),
        (broken(lambda c: c["settings"].update(wings=2)), "settings.wings is 2: no such setting"),
        (broken(lambda c: c.update(data=3)), "data is 3: a text is needed"),
    ],
)
def test_a_broken_config_is_named(run: RunFolder, breaking: Callable[[str], str], said: str) -> None:
    run.config_file.write_text(breaking(run.config_file.read_text(encoding="utf-8")), encoding="utf-8")
    text = error_of(run.config)
    assert text.startswith(str(run.config_file))
    assert said in text


def test_a_folder_without_a_run_is_named(tmp_path: Path, run: RunFolder) -> None:
    assert error_of(RunFolder(tmp_path / "none").config).startswith(f"{tmp_path / 'none'}: not a run: it has no config")
    for file in run.checkpoints():
        file.unlink()
    assert "not a run that can be continued: no checkpoints/step_*.safetensors in it: train first" in error_of(
        run.restore
    )


def test_another_scene_is_refused(run: RunFolder) -> None:
    text = error_of(lambda: run.restore(_with_exchanged_photos(run)))
    assert "whose photos, poses or bounds differ from copy's: open that one" in text


def _with_exchanged_photos(run: RunFolder) -> Path:
    """A copy of the capture with two photos exchanged."""
    import shutil

    source, _ = run.config()
    assert source is not None
    copy = run.path.with_name("copy")
    shutil.copytree(source, copy)
    (copy / "train" / "r_0.png").rename(copy / "train" / "tmp.png")
    (copy / "train" / "r_1.png").rename(copy / "train" / "r_0.png")
    (copy / "train" / "tmp.png").rename(copy / "train" / "r_1.png")
    return copy


def test_a_moved_dataset_is_read_from_its_new_place(run: RunFolder) -> None:
    import shutil

    source, _ = run.config()
    assert source is not None
    moved = run.path.with_name("moved")
    shutil.copytree(source, moved)
    assert run.restore(moved)[0].step_count == 2


def test_options_that_a_run_cannot_change(run: RunFolder, tiny: RunSettings) -> None:
    must_agree(RunSettings(), run)
    must_agree(replace(tiny, steps=999, device="cuda"), run)
    for given, option in [
        (replace(tiny, seed=5), "--seed"),
        (replace(tiny, changes={"rays": "9"}), "--set"),
        (replace(tiny, load=LoadOptions(max_size=8)), "--max-size"),
    ]:
        assert error_of(lambda given=given: must_agree(given, run)).startswith(f"{option}: {run.path} was begun with")


# Imports once, which takes seconds. Then, for each line that it reads, a child saves until it is killed.
SAVER = """
import os
import sys
from pathlib import Path
from nerf_core.training import checkpoint
from nerf_core.training.run_folder import RunFolder
for _ in sys.stdin:
    child = os.fork()
    if not child:
        path, description, state, _ = checkpoint.newest(Path(sys.argv[1]))
        run = RunFolder(Path(sys.argv[1]))
        while True:
            description["step"] += 1
            run.save(description, state)
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.mark.thorough(4)
def test_a_run_killed_while_saving_always_has_a_checkpoint(run: RunFolder) -> None:
    chance, pipe = random.Random(0), subprocess.PIPE
    command = [sys.executable, "-c", SAVER, str(run.path)]
    with ExitStack() as ending:
        savers = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True)
        ending.enter_context(savers)  # which waits for it
        ending.callback(os.killpg, savers.pid, signal.SIGKILL)  # with its child, also when the test fails meanwhile
        assert savers.stdin is not None
        assert savers.stdout is not None
        for _ in range(5):
            before = run.checkpoints()[-1]
            savers.stdin.write("\n")
            savers.stdin.flush()
            process = int(savers.stdout.readline())
            while run.checkpoints()[-1] == before:
                os.kill(process, 0)  # raises an error if it has ended
                time.sleep(0.001)
            time.sleep(chance.uniform(0, 0.02))
            os.kill(process, signal.SIGKILL)
            assert int(savers.stdout.readline()) == -signal.SIGKILL
            _, description, _, rejected = checkpoint.newest(run.path)
            assert rejected == ()
            assert description["step"] >= 3
