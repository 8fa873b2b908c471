"""`nerf-core pose`, and training on photos without poses."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import textured_photos

from nerf_core.captures.raw_photos import raw_photos
from nerf_core.cli import main
from nerf_core.datasets import LoadOptions, load_scene


@pytest.fixture(autouse=True)
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_a_folder_of_photos_becomes_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = str(textured_photos.write(tmp_path / "photos", textured_photos.arc()))
    assert main(["pose", photos, "--quality", "fast"]) == 0
    said = capsys.readouterr().out
    assert "8 of 8 photos have a pose" in said
    assert "found in" in said
    run = str(tmp_path / "run")
    opens = shlex.split(said.splitlines()[-1].removeprefix("next: nerf-viewer "))
    assert opens == [photos, "--poses", "fast"]
    train = ["train", *opens, "--downscale", "8", "--steps", "2", "--out", run, "--device", "cpu"]
    assert main(train) == 0  # they are found again
    assert "finding features" not in capsys.readouterr().out
    assert main(["eval", run]) == 0
    assert "finding features" not in capsys.readouterr().out
    page = tmp_path / "report.html"
    assert main(["report", photos, "--poses", "fast", "--downscale", "8", "--out", str(page)]) == 0
    assert page.is_file()
    capsys.readouterr()
    assert main(["pose", photos, "--quality", "fast"]) == 0
    assert "found again" in capsys.readouterr().out


def test_the_next_command_opens_the_poses_in_a_folder_of_ones_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = str(textured_photos.write(tmp_path / "photos", textured_photos.arc()))
    assert main(["pose", photos, "--quality", "fast", "--out", str(tmp_path / "my poses")]) == 0
    (folder,) = shlex.split(capsys.readouterr().out.splitlines()[-1].removeprefix("next: nerf-viewer "))
    assert folder == str(tmp_path / "my poses")
    assert raw_photos(Path(folder)) is None  # nothing is searched for again
    assert len(load_scene(Path(folder), LoadOptions()).views) == 8


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["gone"], "does not exist"),
        (["empty"], "empty is an empty folder: name a folder of photos, or a video"),
        (["notes"], "notes holds no photos and no video: name a folder of photos, or a video"),
        (["two/photo 0.png"], "is one photo: name"),
        (["posed"], "has poses already"),
        (["text"], "text is no video: name"),
        (["two"], "holds 2 photos: at least 3 are needed"),
        (
            ["damaged"],
            "damaged/a.jpg: no image that can be read), which leaves 0 photos: at least 3 are needed, and 30 to 100",
        ),
        (["damaged"], "damaged: 3 of 3 photos cannot be read (first "),
        (["two", "--minutes", "0"], "--minutes is 0.0"),
    ],
)
def test_errors_are_one_line(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes/a.txt").write_text("")
    textured_photos.write(tmp_path / "two", textured_photos.arc(2))
    (tmp_path / "posed").mkdir()
    (tmp_path / "posed/transforms.json").write_text("{}")
    (tmp_path / "text").write_text("")
    (tmp_path / "damaged").mkdir()
    for name in "abc":
        (tmp_path / f"damaged/{name}.jpg").write_bytes(b"no JPEG")
    assert main(["pose", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line


def test_the_commands_say_the_same_of_a_folder_by_the_name_that_it_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for given in ("empty", "../" + tmp_path.name + "/empty", str(tmp_path / "empty")):
        for command in ("train", "pose", "report"):
            assert main([command, given]) == 2
            words = f"nerf-core: {given} is an empty folder: name a folder of photos, or a video\n"
            assert capsys.readouterr().err == words


@pytest.mark.parametrize(
    ("out", "words"),
    [
        ("photos", "photos holds the photos or lies among them: choose another --out"),
        ("photos/run", "photos/run holds the photos or lies among them: choose another --out"),
        (".", ". holds the photos or lies among them: choose another --out"),
        ("notes", "notes is not empty and holds no run: choose another --out"),
    ],
)
def test_a_training_writes_nothing_where_other_files_are(
    out: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The folder is refused before poses are searched for, and stays as it was."""
    monkeypatch.chdir(tmp_path)
    textured_photos.write(tmp_path / "photos", textured_photos.arc(3))
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes/list.txt").write_text("bread")
    before = sorted(tmp_path.rglob("*"))
    assert main(["train", "photos", "--device", "cpu", "--out", out]) == 2
    assert capsys.readouterr().err == f"nerf-core: {words}\n"
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--method", "nerf", "--preset", "quik"], "method nerf has no such preset; did you mean quick?"),
        (["--method", "voxels", "--preset", "quick"], "method voxels has none but auto; change constants with --set"),
    ],
)
def test_a_misspelt_preset_is_told_before_poses_are_searched_for(
    options: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("nerf_core.captures.opening.find_poses", lambda *_: pytest.fail("poses are searched for"))
    photos = str(textured_photos.write(tmp_path / "photos", textured_photos.arc(3)))
    assert main(["train", photos, "--device", "cpu", "--out", str(tmp_path / "run"), *options]) == 2
    assert capsys.readouterr().err == f"nerf-core: --preset '{options[-1]}': {words}\n"
