"""Large captures: photos that are read while training goes on already."""

from __future__ import annotations

import errno
import gc
import hashlib
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nerf_core.common import cache
from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.datasets.images import read_photo
from nerf_core.datasets.large import spread_order
from nerf_core.geometry import photos as pixels
from nerf_core.geometry.scene import Scene
from nerf_core.methods import Draw
from nerf_core.training.batches import PixelSampler, block_colors, shrunk
from nerf_core.training.settings import RunSettings
from nerf_core.training.trainer import Trainer

CPU = torch.device("cpu")
Capture = tuple[Path, dict[str, Any]]


@pytest.fixture
def large(transforms_folder: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture of ten photos that counts as large; training begins with three and adds one a step."""
    monkeypatch.setattr(cache, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr("nerf_core.datasets.large.LARGE_PIXELS", 1000)
    monkeypatch.setattr(pixels, "FIRST_PHOTOS", 3)
    monkeypatch.setattr(pixels, "PHOTOS_A_STEP", 1)
    return transforms_folder[0]


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """The threads of the background wait for it."""
    go = threading.Event()
    go_on = "nerf_core.datasets.arriving._Work.go_on"
    from nerf_core.datasets.arriving import _Work

    usual = _Work.go_on
    monkeypatch.setattr(go_on, lambda work: (go.wait(), usual(work)))
    yield go
    go.set()


def opened(folder: Path, **options: Any) -> Scene:
    scene = load_scene(folder, LoadOptions(**options))
    assert scene.photos.filling is not None
    return scene


def all_read(scene: Scene) -> None:
    end = time.monotonic() + 20
    while scene.photos.reading() is not None:
        assert time.monotonic() < end
        time.sleep(0.005)


def weights(scene: Scene, steps: int = 4) -> str:
    trainer = Trainer(scene, RunSettings(method="voxels", threads=1))
    for _ in range(steps):
        trainer.step()
    return hashlib.sha256(b"".join(v.numpy().tobytes() for v in trainer.state().values())).hexdigest()


def test_the_photos_are_those_of_a_small_capture(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = opened(large)
    with monkeypatch.context() as patch:
        patch.setattr("nerf_core.datasets.large.LARGE_PIXELS", 4e9)
        small = load_scene(large, LoadOptions())
    assert small.photos.filling is None
    assert [view.name for view in scene.views] == [view.name for view in small.views]
    for one, other in zip(scene.images, small.images, strict=True):  # those not there yet are read now
        np.testing.assert_array_equal(one, other)


def test_training_begins_with_the_first_photos_and_waits_for_more(large: Path, held: threading.Event) -> None:
    scene = opened(large)
    assert scene.photos.present().sum() == 3
    assert scene.photos.reading() == (3, 10, None)
    trainer, waited = Trainer(scene, RunSettings(method="voxels", threads=1)), 0

    def callback() -> None:
        nonlocal waited
        waited += scene.photos.reading() is not None and trainer.step_count == 1
        if waited > 2:
            held.set()

    trainer.step(callback)
    assert scene.photos.present().sum() == 3
    trainer.step(callback)  # wants a fourth, for which it calls back until it is there
    assert waited > 2


def test_weights_do_not_depend_on_how_fast_photos_arrive(large: Path, held: threading.Event) -> None:
    held.set()
    slow = weights(opened(large))  # while the others are read
    again = opened(large)
    all_read(again)
    assert weights(again) == slow
    cache.clear(cache.entries())
    complete = opened(large)
    all_read(complete)
    assert weights(complete) == slow
    assert complete.identity() == again.identity()


def test_a_second_opening_reads_nothing(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = opened(large)
    all_read(scene)
    images = [np.array(image) for image in scene.images]
    (entry,) = cache.entries()
    while (entry.folder / entry.name / "there").read_bytes() != b"\1" * 10:
        time.sleep(0.01)  # the last photos are flushed before they are marked

    def never(*_: object, **__: object) -> None:
        raise AssertionError("a photo was decoded")

    monkeypatch.setattr("nerf_core.datasets.large.read_photo", never)
    again = opened(large)
    assert again.photos.reading() is None
    for one, other in zip(again.images, images, strict=True):
        np.testing.assert_array_equal(one, other)
    assert "in about" not in " ".join(again.notes)


@pytest.mark.parametrize("change", ["photo", "downscale", "background"])
def test_what_changes_pixels_changes_the_entry(large: Path, change: str) -> None:
    opened(large)
    if change == "photo":
        Image.new("RGB", (24, 16), (9, 9, 9)).save(large / "images" / "0004.png")
    scene = opened(
        large, **({} if change == "photo" else {"downscale": 2} if change == "downscale" else {change: "white"})
    )
    assert len(cache.entries()) == 2
    if change == "photo":
        assert (scene.images[4] == 9 * 257).all()


def test_a_killed_process_leaves_no_photo_in_name_only(large: Path, held: threading.Event) -> None:
    scene = opened(large)
    (entry,) = cache.entries()
    files = entry.folder / entry.name
    assert (files / "there").read_bytes() == bytes(10)  # nothing is flushed yet
    assert (files / "pixels").stat().st_size == 10 * 24 * 16 * 3
    images = [np.array(image) for image in scene.images]
    (files / "pixels").write_bytes(bytes(10 * 24 * 16 * 3))  # as after a power cut
    (files / "there").write_bytes(bytes([0] * 9 + [1]))
    again = opened(large)
    assert again.photos.present().sum() == 4  # the three first ones are read anew
    np.testing.assert_array_equal(again.images[0], images[0])
    held.set()


@pytest.mark.parametrize("left", [None, 100])
def test_marks_without_their_pixels_count_for_nothing(large: Path, left: int | None) -> None:
    """As after a deletion that was killed midway: no photo may be black, then or at the next opening."""
    scene = opened(large)
    all_read(scene)
    images = [np.array(image) for image in scene.images]
    (entry,) = cache.entries()
    files = entry.folder / entry.name
    end = time.monotonic() + 20
    while (files / "there").read_bytes() != b"\1" * 10:  # marks come after the pixels
        assert time.monotonic() < end
        time.sleep(0.005)
    (files / "pixels").unlink()
    if left is not None:
        (files / "pixels").write_bytes(bytes(left))
    again = opened(large)
    for image, wanted in zip(again.images, images, strict=True):
        np.testing.assert_array_equal(image, wanted)
    assert (files / "pixels").read_bytes() != bytes(10 * 24 * 16 * 3)


def test_two_openings_at_once_do_no_harm(large: Path, held: threading.Event) -> None:
    one, other = opened(large), opened(large)
    held.set()
    all_read(one)
    all_read(other)
    for a, b in zip(one.images, other.images, strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(cache.entries()) == 1


@pytest.mark.parametrize("fault", ["full", "read-only", "bound"])
def test_without_a_cache_it_goes_on_in_memory(large: Path, monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    if fault == "full":

        def full(*_: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr("os.posix_fallocate", full)
    elif fault == "read-only":
        (large / "cache").write_bytes(b"")  # a file where the folder would be
    else:
        monkeypatch.setattr(cache, "MOST_BYTES", 100)
    scene = opened(large)
    (note,) = [note for note in scene.notes if "in memory and not in the cache" in note]
    assert {"full": "No space", "read-only": "Not a directory", "bound": "more than the cache holds"}[fault] in note
    assert cache.entries() == []
    all_read(scene)
    np.testing.assert_array_equal(scene.images[3], read_photo(large / "images" / "0003.png", (24, 16), (0, 0, 0)))


def test_a_disk_that_fills_up_later_ends_training_in_one_line(
    large: Path, held: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = opened(large)

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.write", full)
    held.set()
    trainer = Trainer(scene, RunSettings(method="voxels", threads=1))
    with pytest.raises(UserError, match="No space left on device: check its rights and the space"):
        [trainer.step() for _ in range(5)]


def test_damaged_photos_are_told_and_never_drawn(large: Path, held: threading.Event) -> None:
    damaged = {2, 7}
    for k in damaged:
        file = large / "images" / f"{k:04}.png"
        file.write_bytes(file.read_bytes()[:-200])
    scene = opened(large)
    held.set()
    all_read(scene)
    assert set(np.flatnonzero(~scene.photos.present())) == damaged
    assert scene.photos.filling is not None
    assert len(scene.photos.filling.damaged()) == 2
    mask = scene.photos.mask(2)
    assert mask is not None
    assert not mask.any()
    assert not scene.photos.counts(7, 0, 0)
    sampler = PixelSampler(scene, 0, CPU, 0)
    drawn = {sampler.views[k] for k in sampler.batch(Draw(3000), step=100).photo.tolist()}
    assert drawn == set(scene.split("train")) - damaged
    one = sampler.batch(Draw(10, one_image=True), step=100).photo
    assert len(set(one.tolist())) == 1


def test_if_nothing_can_be_read_it_is_said(large: Path) -> None:
    for file in (large / "images").iterdir():
        file.write_bytes(file.read_bytes()[:-200])
    with pytest.raises(UserError, match=r"no photo can be read .*: save them as PNG or JPEG"):
        load_scene(large, LoadOptions())


def test_opening_can_be_cancelled(large: Path) -> None:
    class Cancelled(Exception):
        pass

    def progress(words: str, done: int, total: int) -> None:
        if words == "reading the first photos":
            raise Cancelled

    with pytest.raises(Cancelled):
        load_scene(large, LoadOptions(), progress)
    gc.collect()
    assert not [t for t in threading.enumerate() if t.name == "photos"]


def test_reading_ends_with_its_scene(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(*args: Any, **more: Any) -> np.ndarray:
        time.sleep(0.05)
        return read_photo(*args, **more)

    monkeypatch.setattr("nerf_core.datasets.large.read_photo", slow)
    scene = opened(large)
    assert [t for t in threading.enumerate() if t.name == "photos"]
    del scene
    gc.collect()
    end = time.monotonic() + 5
    while [t for t in threading.enumerate() if t.name == "photos"]:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_drawn_blocks_have_the_means_of_stored_ones(large: Path) -> None:
    scene = opened(large)
    all_read(scene)
    rng = np.random.default_rng(0)
    for factor in (1, 2, 4):
        sizes = [(24 // factor, 16 // factor)] * 10
        stored = shrunk(scene.photos, sizes, factor)
        index = torch.from_numpy(rng.integers(0, 10, 200))
        pixel = torch.from_numpy(rng.integers(0, sizes[0], (200, 2)))
        found = block_colors(scene.photos, index, pixel, factor).numpy() * 65535
        meant = [stored.part(k, y, x) for k, (x, y) in zip(index.tolist(), pixel.tolist(), strict=True)]
        np.testing.assert_allclose(found, np.array(meant), atol=1.01)


def test_every_beginning_of_the_order_is_spread() -> None:
    train = tuple(k for k in range(1000) if k % 8)
    order = spread_order(1000, train)
    assert sorted(order.tolist()) == list(range(1000))
    assert set(order[: len(train)].tolist()) == set(train)
    for count in (10, 64, 100):
        gaps = np.diff(np.sort(order[:count]), prepend=0, append=1000)
        assert gaps.max() <= 2.5 * 1000 / count


@pytest.mark.parametrize(
    ("downscale", "free", "said"),
    [
        (1, 6000.0, "--downscale 2 suits this machine better (6 kB of memory are free): 12×8, 2.88 kB, read in"),
        (2, 3000.0, "--downscale 4 suits this machine better (3 kB of memory are free): 6×4, 1.44 kB, read in"),
    ],
)
def test_a_better_downscale_is_proposed(
    large: Path, monkeypatch: pytest.MonkeyPatch, downscale: int, free: float, said: str
) -> None:
    monkeypatch.setattr("nerf_core.datasets.large.free_memory", lambda: free)
    (note,) = [note for note in opened(large, downscale=downscale).notes if note.startswith("--downscale")]
    assert note.startswith(said)


def test_a_fast_jpeg_has_the_colours_of_a_whole_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    coarse = Image.fromarray(rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)).resize(
        (1600, 1200), Image.Resampling.BICUBIC
    )
    fine = np.asarray(coarse, np.float32) + rng.normal(0, 12, (1200, 1600, 1))
    Image.fromarray(fine.clip(0, 255).astype(np.uint8)).save(tmp_path / "a.jpg", quality=92)
    whole, fast = (
        read_photo(tmp_path / "a.jpg", (200, 150), (0, 0, 0), fast=f).astype(float) / 257 for f in (False, True)
    )
    assert (whole != fast).any()
    assert abs((fast - whole).mean((0, 1))).max() < 0.1  # of 255
    assert np.sqrt(((fast - whole) ** 2).mean()) < 1


def test_an_earlier_checkpoint_is_accepted_with_a_warning(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("nerf_core.datasets.large.LARGE_PIXELS", 4e9)
        small = load_scene(large, LoadOptions())
    trainer = Trainer(small, RunSettings(method="voxels", threads=1))
    scene, description = opened(large), trainer.describe()
    assert scene.is_of(description)
    assert "not compared" in scene.doubt(description)
    assert not scene.is_of(description | {"scene_summary": "another"})
    own = Trainer(scene, RunSettings(method="voxels", threads=1)).describe()
    assert scene.is_of(own)
    assert not scene.doubt(own)
    assert not scene.is_of(own | {"scene": "another"})
