import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import write_photo
from PIL import Image

from nerf_core.common.errors import UserError
from nerf_core.datasets import DATASETS, LoadOptions, load_scene, loading
from nerf_core.geometry.scene import Scene

Folder = tuple[Path, dict[str, Any]]
AUTO = LoadOptions()


def notes(scene: Scene) -> str:
    return "\n".join(scene.notes)


def rewrite(folder: Path, document: dict[str, Any]) -> None:
    (folder / "transforms.json").write_text(json.dumps(document))


def test_without_a_path_the_demo_scene_opens() -> None:
    scene = load_scene(None, AUTO)
    assert (scene.name, scene.format, scene.background, scene.synthetic) == ("demo", "demo", (1, 1, 1), True)
    assert len(scene.split("train")) >= 60
    assert len(scene.split("test")) >= 10
    assert scene.images[0].shape == (200, 200, 3)
    assert 0 < scene.near < scene.far
    assert len({view.name for view in scene.views}) == len(scene.views)
    with pytest.raises(UserError, match="--format demo opens the scene that is installed: leave out"):
        load_scene(Path("x"), LoadOptions(format="demo"))
    with pytest.raises(UserError, match=r"unknown dataset format 'nosuch': choose one of .*blender, "):
        load_scene(None, LoadOptions("nosuch"))
    with pytest.raises(UserError, match="--format colmap needs a dataset"):
        load_scene(None, LoadOptions(format="colmap"))


def test_blender_scenes_keep_their_frame(blender_folder: Folder) -> None:
    folder, documents = blender_folder
    scene = load_scene(folder, LoadOptions(downscale=2))
    assert (scene.format, scene.near, scene.far, scene.background) == ("blender", 2, 6, (1, 1, 1))
    pose = np.array(documents["train"]["frames"][1]["transform_matrix"])[:3]
    np.testing.assert_allclose(scene.views[1].camera.c2w, pose, atol=1e-12)
    assert np.array_equal(scene.to_input, np.eye(4))
    with Image.open(folder / "train/r_1.png") as image:
        pixels = np.asarray(image) / 255
    premultiplied = (pixels[..., :3] * pixels[..., 3:]).reshape(8, 2, 8, 2, 3).mean((1, 3))
    alpha = pixels[..., 3:].reshape(8, 2, 8, 2, 1).mean((1, 3))
    np.testing.assert_allclose(scene.images[1] / 65535, premultiplied + 1 - alpha, atol=1e-5)
    black = load_scene(folder, LoadOptions(downscale=2, background="black"))
    np.testing.assert_allclose(black.images[1] / 65535, premultiplied, atol=1e-5)


def test_every_eighth_photo_is_held_out_and_downscaling_keeps_the_view(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    scene = load_scene(folder, LoadOptions(downscale=3))
    assert scene.splits == {"train": (1, 2, 3, 4, 5, 6, 7, 9), "test": (0, 8)}
    assert scene.images[0].shape == (5, 8, 3)
    camera = scene.views[0].camera
    assert camera.intrinsics()[:6] == pytest.approx((8, 5, 10, 31 * 5 / 16, 12.5 / 3, 7.5 * 5 / 16))
    assert scene.background == (0, 0, 0)
    assert load_scene(folder, LoadOptions(max_size=12)).images[0].shape == (8, 12, 3)
    assert load_scene(folder, LoadOptions(max_size=1200)).images[0].shape == (16, 24, 3)


def test_photos_that_were_reduced_on_disk_take_their_calibration_along(transforms_folder: Folder) -> None:
    folder, document = transforms_folder
    rewrite(folder, document | {"w": 96, "h": 64, "fl_x": 120, "fl_y": 120, "cx": 48, "cy": 32})
    assert load_scene(folder, AUTO).views[0].camera.intrinsics()[:6] == (24, 16, 30, 30, 12, 8)
    rewrite(folder, document | {"w": 96, "h": 96})
    with pytest.raises(UserError, match=r"0000\.png is 24×16 pixels, but its calibration is for 96×96"):
        load_scene(folder, AUTO)


def test_exif_turns_a_photo_only_where_the_calibration_says_so(transforms_folder: Folder) -> None:
    folder, document = transforms_folder
    exif = Image.Exif()
    exif[0x0112] = 6
    path = folder / "images/0001.png"
    with Image.open(path) as image:
        stored = np.asarray(image.convert("RGB"))
    Image.fromarray(stored).save(path, exif=exif)
    scene = load_scene(folder, AUTO)
    assert np.array_equal(scene.images[1] // 257, stored)
    assert "1 photo with an EXIF rotation: 0 turned by it, 1 taken as stored" in notes(scene)
    document["frames"][1] |= {"w": 16, "h": 24}
    rewrite(folder, document)
    scene = load_scene(folder, AUTO)
    assert np.array_equal(scene.images[1] // 257, np.rot90(stored, -1))
    assert {image.shape for image in scene.images} == {(16, 24, 3), (24, 16, 3)}  # both orientations in one scene


def test_damaged_photos_are_skipped_and_counted(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    (folder / "images/0000.png").write_bytes(b"")
    whole = (folder / "images/0001.png").read_bytes()
    (folder / "images/0001.png").write_bytes(whole[: len(whole) // 2])
    scene = load_scene(folder, AUTO)
    assert [view.name for view in scene.views] == [f"images/{i:04}.png" for i in range(2, 10)]
    assert scene.splits == {"train": tuple(range(1, 8)), "test": (0,)}
    assert "2 damaged photos are skipped, first" in notes(scene)
    for i in range(2, 10):
        (folder / f"images/{i:04}.png").write_bytes(b"")
    with pytest.raises(UserError, match="no photo can be read"):
        load_scene(folder, AUTO)


def test_memory_decides_the_size(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    whole = 10 * 24 * 16 * 3 / 1e9  # 8 bits a channel
    assert not load_scene(folder, LoadOptions(memory_gb=whole)).notes
    scene = load_scene(folder, LoadOptions(memory_gb=whole / 2))
    assert scene.images[0].shape == (8, 12, 3)
    assert "photos are downscaled by a further 2, to 12×8, to fit into" in notes(scene)
    with pytest.raises(UserError, match="24×16 pixels has none left"):
        load_scene(folder, LoadOptions(memory_gb=1e-12))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (LoadOptions(downscale=0), "--downscale is 0"),
        (LoadOptions(downscale=33), "24×16 pixels has none left at --downscale 33"),
        (LoadOptions(max_size=-1), "--max-size is -1"),
        (LoadOptions(memory_gb=0), "--memory-gb is 0"),
        (LoadOptions(memory_gb=float("nan")), "--memory-gb is nan"),
        (LoadOptions(format="nerf"), "unknown dataset format 'nerf': choose one of .*blender, .*transforms"),
        (LoadOptions(format="blender"), r"transforms_train\.json does not exist"),
    ],
)
def test_wrong_options_are_named(transforms_folder: Folder, options: LoadOptions, text: str) -> None:
    with pytest.raises(UserError, match=text):
        load_scene(transforms_folder[0], options)


def test_odd_calibrations_are_noted(transforms_folder: Folder) -> None:
    folder, document = transforms_folder
    rewrite(folder, document | {"fl_x": 72_000.0})
    assert "10 photos with a focal length of 3e+03 image sizes" in notes(load_scene(folder, AUTO))
    rewrite(folder, document | {"cx": -240})
    assert "10 photos with a principal point 10.5 image sizes from the centre" in notes(load_scene(folder, AUTO))
    for lens in ({"k1": -3.0}, {"k2": 1e12}, {"k1": -1e12, "p1": 1e12}):
        rewrite(folder, document | lens)
        assert "lens coefficients that fold the image" in notes(load_scene(folder, AUTO))
    rewrite(folder, document | {"k1": 0.05, "k2": -0.08, "p1": 1e-3})
    assert not load_scene(folder, AUTO).notes


def test_progress_counts_photos_and_may_cancel(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    calls: list[tuple[str, int, int]] = []
    load_scene(folder, AUTO, lambda *call: calls.append(call))
    assert calls.pop(0) == ("looking for masks", 0, 10)
    assert calls == [(words, i, 10) for words in ("checking photos", "loading photos") for i in range(1, 11)]

    class StopError(Exception):
        pass

    def stop(words: str, done: int, total: int) -> None:
        raise StopError

    with pytest.raises(StopError):
        load_scene(folder, AUTO, stop)


def test_several_formats_in_one_folder(transforms_folder: Folder, blender_folder: Folder) -> None:
    assert transforms_folder[0] == blender_folder[0]
    scene = load_scene(transforms_folder[0], AUTO)
    assert scene.format == "blender"
    assert "holds blender and transforms: took blender; --format chooses" in notes(scene)
    assert load_scene(transforms_folder[0], LoadOptions(format="transforms")).format == "transforms"
    assert load_scene(transforms_folder[0] / "transforms.json", AUTO).format == "transforms"


def test_a_path_that_is_no_dataset_is_refused(tmp_path: Path, transforms_folder: Folder) -> None:
    folder, _ = transforms_folder

    def refused(path: Path, text: str) -> None:
        with pytest.raises(UserError, match=text) as caught:
            load_scene(path, AUTO)
        assert "\n" not in str(caught.value)

    refused(folder / "none", "none does not exist: name the folder")
    refused(folder / "images/0000.png", r"0000\.png is one photo: name a folder of photos, or a video$")
    (folder / "notes.txt").write_text("")
    refused(folder / "notes.txt", r"notes\.txt is not a folder: name the folder of a dataset, or its \.json")
    refused(
        folder / "images",
        r"images holds 10 photos without poses; formats that carry poses: .*blender \(tran.*colmap.*llff",
    )
    (folder / "outer").mkdir()
    shutil.copytree(folder / "images", folder / "outer/inner/images")
    shutil.copy(folder / "transforms.json", folder / "outer/inner")
    refused(folder / "outer", r"outer is not a dataset itself, but .*inner is one: open that")
    (folder / "empty").mkdir()
    refused(folder / "empty", "empty is an empty folder: name a folder of photos, or a video$")


def test_names_with_spaces_and_emoji_and_long_paths(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    deep = folder / "näme with spaces 🦊" / ("long " * 40) / ("longer " * 30)
    deep.mkdir(parents=True)
    for name in ("images", "transforms.json"):
        (folder / name).rename(deep / name)
    assert len(load_scene(deep, AUTO).views) == 10


def test_photos_are_only_read(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    load_scene(folder, AUTO)
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


def test_ranks_of_formats_differ() -> None:
    ranks = [DATASETS.get(name).rank for name in DATASETS.names()]
    assert len(set(ranks)) == len(ranks)


@pytest.mark.parametrize("name", DATASETS.names())
def test_every_format_says_what_it_needs_and_refuses_what_it_does_not_know(name: str, tmp_path: Path) -> None:
    kind = DATASETS.get(name)
    assert kind.files
    empty, photos, text = tmp_path / "empty", tmp_path / "photos", tmp_path / "notes.json"
    empty.mkdir()
    write_photo(photos / "a.png")
    text.write_text("no JSON", encoding="utf-8")
    assert isinstance(kind.matches(text), bool)  # it may take any .json file for its own, but never raises
    for path in (empty, photos, tmp_path / "missing"):
        assert not kind.matches(path)
    for path in (empty, photos, text, tmp_path / "missing"):
        with pytest.raises(UserError) as caught:
            load_scene(path, LoadOptions(format=name))
        assert "\n" not in str(caught.value)


def test_lego(scenes: Path) -> None:
    scene = load_scene(scenes / "lego", LoadOptions(downscale=8))
    assert {k: len(v) for k, v in scene.splits.items()} == {"train": 100, "val": 13, "test": 25}
    assert {image.shape for image in scene.images} == {(100, 100, 3)}
    assert (scene.format, scene.near, scene.far, scene.notes) == ("blender", 2, 6, ())
    assert scene.images[0][0, 0].tolist() == [65535] * 3


def test_fox(scenes: Path) -> None:
    scene = load_scene(scenes / "fox", LoadOptions(downscale=8))
    assert len(scene.views) == 50
    assert {k: len(v) for k, v in scene.splits.items()} == {"train": 43, "test": 7}
    assert {image.shape for image in scene.images} == {(240, 135, 3)}
    assert scene.views[0].camera.lens.k1 == 0.0578421
    assert "17 of 67 listed photos are missing" in notes(scene)


@pytest.mark.parametrize(
    ("size", "reduced", "downscale", "words"),
    [
        ((1080, 1920), 1, 400, "it leaves 3×5 of the 1080×1920 pixels of a photo: give at most 123"),
        ((1080, 1920), 1, 124, "it leaves 9×15 of the 1080×1920 pixels of a photo: give at most 123"),
        ((1080, 1920), 1, 123, ""),
        ((40, 24), 4, 11, "it leaves 15×9 of the 160×96 pixels of a photo: give at most 10"),
        ((40, 24), 4, 10, ""),
        ((40, 24), 4, 2, ""),
        ((12, 10), 1, 2, "it leaves 6×5 of the 12×10 pixels of a photo: give at most 1"),
        ((12, 10), 1, 1, ""),
    ],
)
def test_a_downscale_that_leaves_hardly_a_pixel_is_refused(
    size: tuple[int, int],
    reduced: int,
    downscale: int,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loading, "LEAST_SIDE", 16)
    if not words:
        loading._refuse_tiny(size, downscale, reduced)
        return
    with pytest.raises(UserError) as caught:
        loading._refuse_tiny(size, downscale, reduced)
    assert str(caught.value) == f"--downscale is {downscale}: {words}"


def test_a_downscale_is_refused_before_photos_are_read(
    transforms_folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loading, "LEAST_SIDE", 16)
    monkeypatch.setattr(loading, "read_photo", lambda *_: pytest.fail("a photo is read"))
    with pytest.raises(
        UserError, match="--downscale is 2: it leaves 12×8 of the 24×16 pixels of a photo: give at most 1"
    ):
        load_scene(transforms_folder[0], LoadOptions(downscale=2))
