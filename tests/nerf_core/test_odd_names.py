"""Folders, photos and written files with names that are not UTF-8 or that would break a line, in every command."""

from __future__ import annotations

import json
import os
import select
import shutil
from contextlib import redirect_stdout
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from odd_names import ODD, PHOTOS, SHOWN, assert_printable, needs_bytes, write_capture

from nerf_core.cli import main
from nerf_core.common.console import Display
from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.camera_files import picked_camera
from nerf_core.training.run_folder import RunFolder

TINY = [
    "--method", "nerf", "--device", "cpu", "--threads", "1", "--set", "coarse_samples=8", "--set", "rays=32",
    "--set", "fine_samples=8", "--set", "depth=2", "--set", "width=16",
]  # fmt: skip

pytestmark = needs_bytes


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_capture(tmp_path_factory.mktemp("captures"))


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / ODD
    assert main(["train", str(capture), "--out", str(out), "--steps", "2", *TINY]) == 0
    return out


def says(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> str:
    """Run a command and return what it printed, which must be printable."""
    capsys.readouterr()
    assert main(arguments) == status
    said = capsys.readouterr()
    assert_printable(said.out + said.err)
    return said.out + said.err


def test_a_run_is_trained_and_continued(run: Path, capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = str(run).replace(ODD, SHOWN)
    said = says(capsys, "train", "--out", str(run), "--resume", "--steps", "4", *TINY)
    assert f"continuing {shown} at step 2" in said
    assert f" on {SHOWN} ({PHOTOS - 1} photos)" in said
    assert f"; saved {shown}" in said
    assert RunFolder(run).config()[0] == capture  # what is stored opens again, byte for byte
    for file in (run / "config.json", run / "log.jsonl"):
        file.read_text("utf-8")
    assert f"{shown}: holds a run already" in says(capsys, "train", str(capture), "--out", str(run), *TINY, status=2)


def test_a_run_has_its_default_folder(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert f"saved runs/{SHOWN}-nerf/" in says(capsys, "train", str(capture), "--steps", "1", *TINY)
    assert (tmp_path / "runs" / f"{ODD}-nerf" / "config.json").is_file()


def test_a_run_is_compared_with_photos(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = says(capsys, "eval", str(run), "--split", "train", "--views", "1")
    assert f"wrote {str(run).replace(ODD, SHOWN)}/metrics.json" in said
    (image,) = json.loads((run / "metrics.json").read_text("utf-8"))["images"]
    assert image["name"] == f"images/1{SHOWN}.png"
    assert (run / "eval" / image["name"]).is_file()


def test_a_film_is_written(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / ODD / f"{ODD}.mp4"
    said = says(capsys, "render", str(run), "--out", str(film), "--frames", "2", "--png-frames")
    assert f"{SHOWN}.mp4: 2 frames" in said
    assert imageio_ffmpeg.count_frames_and_secs(str(film))[0] == 2
    assert f"{SHOWN}.gif" in says(capsys, "render", str(run), "--out", str(film.with_suffix(".gif")), status=2)


@pytest.mark.parametrize("suffix", ["json", "npz", "csv", "png", "svg"])
def test_a_pixel_is_opened(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str) -> None:
    file = tmp_path / ODD / f"{ODD}.{suffix}"
    for name in (f"images/1{ODD}.png", f"images/1{SHOWN}.png"):  # as it is, and as it is shown
        said = says(capsys, "probe", str(run), "--camera", name, "--pixel", "12", "8", "--write", str(file))
        assert f"{SHOWN}.{suffix}" in said
    if suffix in ("json", "csv", "svg"):
        file.read_text("utf-8").encode()
    if suffix == "json":
        assert json.loads(file.read_text("utf-8"))["scene"] == SHOWN


def test_what_is_missing_is_named(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = tmp_path / f"no {ODD}"
    for words in (
        ["train", str(nowhere)],
        ["train", f"--{ODD}"],
        ["train", "--set", f"{ODD}=1"],
        ["eval", str(nowhere)],
        ["eval", str(run), "--lpips-weights", str(nowhere)],
        ["eval", str(run), "--data", str(nowhere)],
        ["probe", str(run), "--camera", f"{ODD}.json", "--pixel", "1", "1"],
        ["probe", str(run), "--camera", ODD, "--pixel", "1", "1"],
        ["render", str(run), "--out", "a.mp4", "--path", ODD],
        ["export", str(run), str(nowhere)],
        ["methods", ODD],
        [ODD],
    ):
        assert says(capsys, *words, status=2).count("\n") == 1, words


def test_a_checkpoint_is_of_its_capture_alone(run: Path, capture: Path, tmp_path: Path) -> None:
    trainer, _ = RunFolder(run).restore(on="cpu")
    scene = load_scene(capture, LoadOptions())
    assert scene.name == SHOWN
    assert scene.identity() == trainer.scene.identity()
    assert picked_camera(scene, f"1{ODD}").c2w.tolist() == scene.views[1].camera.c2w.tolist()
    shutil.copytree(capture, tmp_path / ODD)
    renamed = (tmp_path / ODD / "transforms.json").read_text("utf-8").replace(r"\udcff", r"\udcfe")
    (tmp_path / ODD / "transforms.json").write_text(renamed, encoding="utf-8")
    for photo in (tmp_path / ODD / "images").iterdir():
        photo.rename(photo.with_name(photo.name.replace("\udcff", "\udcfe")))
    with pytest.raises(UserError) as refused:
        RunFolder(run).restore(tmp_path / ODD, on="cpu")
    assert_printable(str(refused.value))
    assert "\n" not in str(refused.value)


def test_names_stay_apart(tmp_path: Path) -> None:
    folder = write_capture(tmp_path)
    text = (folder / "transforms.json").read_text("utf-8")
    twins = ["images/a\udcff.png", r"images/a\xff.png"]
    document = json.loads(text)
    for frame, twin in zip(document["frames"], twins, strict=False):
        (folder / frame["file_path"]).rename(folder / twin)
        frame["file_path"] = twin
    (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8")
    names = [view.name for view in load_scene(folder, LoadOptions()).views]
    assert len(set(names)) == PHOTOS
    for name in names:
        assert_printable(name)


def test_notes_of_a_capture_are_lines(tmp_path: Path) -> None:
    folder = write_capture(tmp_path)
    first, second, *_ = sorted((folder / "images").iterdir())
    first.write_bytes(b"no picture")
    second.unlink()
    notes = load_scene(folder, LoadOptions()).notes
    assert len(notes) >= 2
    for note in notes:
        assert_printable(note)
        assert "\n" not in note


def test_a_progress_bar_takes_any_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal, where square brackets would be markup."""
    import pty  # which only systems with terminals have

    ours, theirs = pty.openpty()
    monkeypatch.setenv("COLUMNS", "200")
    with os.fdopen(theirs, "w", encoding="utf-8") as terminal, redirect_stdout(terminal):
        with Display(f"a[/b] {ODD}") as bar:
            bar.show(0.5, f"[/c] {ODD}")
        terminal.flush()
        said = b""
        while select.select([ours], [], [], 0.3)[0]:  # the system hands over what was written in pieces
            said += os.read(ours, 10_000)
    os.close(ours)
    assert f"[/c] {SHOWN}" in said.decode()
    assert b"\x1b[2J" not in said


def test_arrays_keep_names(run: Path, tmp_path: Path) -> None:
    file = tmp_path / "a.npz"
    assert main(["probe", str(run), "--camera", f"images/1{ODD}.png", "--pixel", "12", "8", "--write", str(file)]) == 0
    with np.load(file) as arrays:
        for name in arrays.files:
            if arrays[name].dtype.kind == "U":
                "".join(arrays[name].ravel().tolist()).encode()
