"""Masks: where they are found, what they mean, and what is said about those that do not fit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import write_photo
from PIL import Image

from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene

Folder = tuple[Path, dict[str, Any]]
HALF = np.repeat([[0] * 12 + [255] * 12], 16, 0).astype(np.uint8)  # the left half is masked


def save(mask: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(path)


@pytest.mark.parametrize("where", [
    "masks/0003.png", "mask/0003.png", "images/masks/0003.png",
    "masks/0003.png.png", "images/0003.mask.png", "images/0003.png.mask.png",
])  # fmt: skip
def test_masks_are_found_beside_the_photos(transforms_folder: Folder, where: str) -> None:
    folder, _ = transforms_folder
    save(HALF, folder / where)
    scene = load_scene(folder, LoadOptions())
    assert scene.photos.masked_photos == (3,)
    np.testing.assert_array_equal(scene.photos.mask(3), HALF > 0)
    assert "9 photos have no mask and are used whole; the others have one" in scene.notes
    small = load_scene(folder, LoadOptions(downscale=5)).photos
    mask = small.mask(3)
    assert mask is not None
    assert mask.tolist() == [[False, False, False, True, True]] * 3  # 12 pixels are 2.5 of 5: the middle one is cut


def test_a_listed_mask_is_taken_and_a_missing_one_noted(transforms_folder: Folder) -> None:
    folder, document = transforms_folder
    save((HALF > 0).astype(np.uint8), folder / "elsewhere/m.png")  # some tools write 0 and 1
    document["frames"][2]["mask_path"] = "elsewhere/m.png"
    document["frames"][4]["mask_path"] = "elsewhere/gone.png"
    (folder / "transforms.json").write_text(json.dumps(document))
    scene = load_scene(folder, LoadOptions())
    np.testing.assert_array_equal(scene.photos.mask(2), HALF > 0)
    assert scene.photos.masked_photos == (2,)
    assert any("1 listed mask is missing" in note and "gone.png" in note for note in scene.notes)


@pytest.mark.parametrize("mode", ["1", "RGB", "RGBA", "P", "I;16", "LA"])
def test_masks_of_any_pixel_type(transforms_folder: Folder, mode: str) -> None:
    folder, _ = transforms_folder
    deep = Image.fromarray(HALF.astype(np.uint16) * 256)
    image = deep if mode == "I;16" else Image.fromarray(HALF).convert(mode)
    (folder / "masks").mkdir()
    image.save(folder / "masks/0000.png")
    np.testing.assert_array_equal(load_scene(folder, LoadOptions()).photos.mask(0), HALF > 0)


def test_masks_of_full_size_fit_smaller_photos_and_other_shapes_are_refused(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    save(np.kron(HALF, np.ones((4, 4), np.uint8)), folder / "masks/0000.png")
    np.testing.assert_array_equal(load_scene(folder, LoadOptions()).photos.mask(0), HALF > 0)
    save(HALF[:, :16], folder / "masks/0001.png")
    with pytest.raises(UserError, match=r"masks/0001.png has 16×16 pixels, its photo .*images/0001.png 24×16"):
        load_scene(folder, LoadOptions())
    (folder / "masks/0001.png").write_bytes(b"no image")
    with pytest.raises(UserError, match=r"masks/0001.png: a mask that cannot be read"):
        load_scene(folder, LoadOptions())


def test_photos_that_are_masked_whole_are_left_out(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    save(0 * HALF, folder / "masks/0003.png")
    scene = load_scene(folder, LoadOptions())
    assert [view.name for view in scene.views] == [f"images/{i:04}.png" for i in range(10) if i != 3]
    assert any("1 photo is masked as a whole and left out, first images/0003.png" in note for note in scene.notes)
    for i in range(10):
        save(0 * HALF, folder / f"masks/{i:04}.png")
    with pytest.raises(UserError, match="every photo is masked as a whole"):
        load_scene(folder, LoadOptions())


def test_alpha_of_a_real_capture_is_a_mask_unless_a_background_is_named(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    write_photo(folder / "images/0005.png", mode="RGBA", seed=5)
    with Image.open(folder / "images/0005.png") as image:
        pixels = np.array(image)
    pixels[..., 3] = np.where(HALF > 0, 255, 100)
    Image.fromarray(pixels).save(folder / "images/0005.png")
    scene = load_scene(folder, LoadOptions())
    np.testing.assert_array_equal(scene.photos.mask(5), HALF > 0)
    assert load_scene(folder, LoadOptions(background="white")).photos.kept is None
    pixels[..., 3] = 255
    Image.fromarray(pixels).save(folder / "images/0005.png")
    assert load_scene(folder, LoadOptions()).photos.kept is None


def test_a_mask_turns_with_its_photo(transforms_folder: Folder) -> None:
    folder, document = transforms_folder
    for frame in document["frames"]:
        (folder / frame["file_path"]).unlink()
    for i, frame in enumerate(document["frames"]):
        exif = Image.Exif()
        exif[0x0112] = 6
        stored = np.random.default_rng(i).integers(0, 256, (24, 16, 3), dtype=np.uint8)
        Image.fromarray(stored).save((folder / frame["file_path"]).with_suffix(".jpg"), exif=exif)
        frame["file_path"] = frame["file_path"].replace(".png", ".jpg")
    (folder / "transforms.json").write_text(json.dumps(document))
    save(HALF, folder / "masks/0001.png")  # drawn on the photo as it is seen
    save(np.rot90(HALF), folder / "masks/0002.jpg.png")  # drawn on the photo as it is stored
    photos = load_scene(folder, LoadOptions()).photos
    np.testing.assert_array_equal(photos.mask(1), HALF > 0)
    np.testing.assert_array_equal(photos.mask(2), HALF > 0)


def test_an_object_on_a_plain_background_keeps_its_pixels(blender_folder: Folder) -> None:
    folder, _ = blender_folder
    save(HALF, folder / "masks/r_1.png")
    assert load_scene(folder, LoadOptions()).photos.kept is None


def test_masked_pixels_are_dimmed_where_photos_are_shown(transforms_folder: Folder) -> None:
    folder, _ = transforms_folder
    save(HALF, folder / "masks/0000.png")
    photos = load_scene(folder, LoadOptions()).photos
    shown, whole = photos.small(0, 24)[..., :3], photos.images[0] >> 8
    np.testing.assert_array_equal(shown[:, 12:], whole[:, 12:])
    np.testing.assert_array_equal(shown[:, :12], whole[:, :12] // 4)
