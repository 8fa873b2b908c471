"""What can go wrong with a search for poses: options, programs, disks, races, and photos that are none for it."""

from __future__ import annotations

import errno
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import textured_photos
from PIL import Image
from searches import FAST, files, of, quiet

from nerf_core.captures import posing, records, search
from nerf_core.captures.panoramas import is_panorama
from nerf_core.captures.posing import Posed, find_poses
from nerf_core.captures.records import PoseOptions, PoseProgress
from nerf_core.common.errors import UserError


def panorama(seed: int) -> np.ndarray:
    """All around a camera, (120, 240, 3) uint8: smooth waves over the sphere of directions."""
    rng = np.random.default_rng(seed)
    latitude, longitude = np.meshgrid((np.arange(120) + 0.5) / 120, (np.arange(240) + 0.5) / 240, indexing="ij")
    a, b = np.pi * (latitude - 0.5), 2 * np.pi * longitude
    directions = np.stack([np.cos(a) * np.sin(b), np.sin(a), np.cos(a) * np.cos(b)], -1)
    waves = np.sin(directions @ rng.normal(0, 6, (3, 9)) + rng.uniform(0, 6, 9)).reshape(120, 240, 3, 3).mean(-1)
    return np.rint(127 + 120 * waves).astype(np.uint8)


def test_panoramas_are_recognised_and_refused(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.fromarray(panorama(k)).save(tmp_path / "photos" / f"{k}.jpg")
    with pytest.raises(UserError, match=r"360° panoramas.*cut perspective views out"):
        find_poses(of(tmp_path / "photos"), tmp_path / "out", FAST, quiet)
    assert not (tmp_path / "out").exists()


def test_other_photos_twice_as_wide_as_high_are_no_panoramas() -> None:
    photo = textured_photos.picture(textured_photos.arc()[0])[:160]
    assert not is_panorama(photo)
    assert not is_panorama(np.full((100, 200, 3), 255, np.uint8))
    on_white = np.full((160, 320, 3), 255, np.uint8)
    on_white[40:120, 80:240] = photo[40:120, 80:240]
    assert not is_panorama(on_white)
    assert not is_panorama(np.roll(panorama(0), 60, 0))  # its poles are in the middle
    assert is_panorama(panorama(0))


PROGRAMS = {
    "hangs": ("import time; time.sleep(60)", FAST, "nothing happened"),
    "takes all memory": (
        "import time; a = bytearray(400_000_000); time.sleep(60)", PoseOptions("fast", memory_gb=0.2), "memory"
    ),
    "takes too long": ("import time; time.sleep(60)", PoseOptions("fast", minutes=0.005), "minutes are over"),
    "is killed": ("import os; os.kill(os.getpid(), 9)", FAST, "crash -9"),
    "fails": ("raise SystemExit('no luck')", FAST, "no luck"),
    "says nothing": ("", FAST, "crash 0"),
}  # fmt: skip


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_that_goes_wrong_harms_nothing(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, options, words = PROGRAMS[name]
    program = tmp_path / "program.py"
    program.write_text(source)
    monkeypatch.setattr(search, "PROGRAM", program)
    if name == "hangs":  # the others may take their time on a busy machine
        monkeypatch.setattr(search, "STALLED", 1.0)
    folder = textured_photos.write(tmp_path / "photos", textured_photos.arc(3))
    begun = time.monotonic()
    with pytest.raises(UserError, match=words):
        find_poses(of(folder), tmp_path / "out", options, quiet)
    assert time.monotonic() - begun < 20
    assert not (tmp_path / "out").exists()


def a_result(job: search.Job) -> dict[str, Any]:
    """What the program leaves if it places all photos."""
    (job.work / "sparse" / "0").mkdir(parents=True)
    n = len(job.names)
    return {"features": [900] * n, "best": [200] * n, "pairs": [2] * n, "turned": [0] * n, "folded": [False],
            "points": 500, "error": 0.5, "placed": list(range(n)), "models": [n]}  # fmt: skip


def test_two_searches_that_end_at_once_give_one_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many times, because it is a race: none fails, one result stays, and nothing else."""
    monkeypatch.setattr(search.Job, "run", a_result)
    photos = of(textured_photos.write(tmp_path / "photos", textured_photos.arc(3)))
    for attempt in range(10):
        out, together = tmp_path / f"out{attempt}", threading.Barrier(3)
        judged = posing._judged

        def wait_and_judge(*args: Any, together: threading.Barrier = together, judged: Any = judged) -> Posed:
            together.wait(20)
            return judged(*args)

        with monkeypatch.context() as patch:
            patch.setattr(posing, "_judged", wait_and_judge)
            with ThreadPoolExecutor(3) as pool:
                found = list(pool.map(lambda _, out=out: find_poses(photos, out, FAST, quiet), range(3)))
        assert {posed.folder for posed in found} == {out}
        assert sum(not posed.again for posed in found) == 1
        assert sorted(f.name for f in out.iterdir()) == ["images", "poses.json", "sparse"]


FULL_DISK = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("step", ["copies", "program", "result"])
def test_a_full_disk_is_said_and_leaves_nothing(step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise FULL_DISK

    folder = textured_photos.write(tmp_path / "photos", textured_photos.arc(3))
    words = "No space left on device: check its rights and the space on its disk"
    if step == "copies":
        monkeypatch.setattr(Image.Image, "save", fails)
    elif step == "program":
        program = tmp_path / "program.py"
        program.write_text("raise SystemExit('database or disk is full')")
        monkeypatch.setattr(search, "PROGRAM", program)
        monkeypatch.setattr(search, "FULL", 1e18)
        words = "is full: free some space"
    else:
        monkeypatch.setattr(search.Job, "run", a_result)
        monkeypatch.setattr(posing, "write_atomically", fails)
    with pytest.raises(UserError, match=words) as found:
        find_poses(of(folder), tmp_path / "out", FAST, quiet)
    assert "\n" not in str(found.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("stage", [records.COPYING, records.STAGES["features"]])
def test_cancelling_leaves_nothing(stage: str, tmp_path: Path) -> None:
    class Enough(BaseException):
        pass

    def cancel(state: PoseProgress) -> None:
        if state.stage == stage:
            raise Enough

    folder = textured_photos.write(tmp_path / "photos", textured_photos.arc(3))
    with pytest.raises(Enough):
        find_poses(of(folder), tmp_path / "out", FAST, cancel)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (PoseOptions("best"), "--quality"),  # pyright: ignore[reportArgumentType]
        (PoseOptions(lens="round"), "--lens"),  # pyright: ignore[reportArgumentType]
        (PoseOptions(frames=2), "--frames"),
        (PoseOptions(minutes=0.0), "--minutes"),
        (PoseOptions(memory_gb=-1.0), "--memory-gb"),
    ],
)
def test_wrong_options_are_named(options: PoseOptions, words: str, tmp_path: Path) -> None:
    folder = textured_photos.write(tmp_path / "photos", textured_photos.arc(3))
    with pytest.raises(UserError, match=words):
        find_poses(of(folder), tmp_path / "out", options, quiet)


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    folder = textured_photos.write(tmp_path / "photos", textured_photos.arc(3))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="is not empty"):
        find_poses(of(folder), tmp_path / "out", FAST, quiet)
    assert files(tmp_path / "out") == ["mine.txt"]


def test_the_users_own_folders_are_never_written_to(tmp_path: Path) -> None:
    folder = textured_photos.write(tmp_path / "mine" / "images", textured_photos.arc(3))
    (tmp_path / "mine" / "poses.json").write_text("{}")
    before = files(tmp_path)
    for out in (folder, folder / "posed", tmp_path / "mine", tmp_path):
        with pytest.raises(UserError, match="name another folder"):
            find_poses(of(folder), out, FAST, quiet)
    assert files(tmp_path) == before
