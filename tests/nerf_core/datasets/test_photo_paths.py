import os
from pathlib import Path

import pytest

from nerf_core.common.errors import UserError
from nerf_core.datasets.photo_paths import find_photos, photo_name

SOURCE = Path("t.json")


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


def names(folder: Path, *listed: str) -> list[str | None]:
    return [path and photo_name(folder, path) for path in find_photos(folder, listed, SOURCE).paths]


def test_listed_files_are_taken_as_they_stand(tmp_path: Path) -> None:
    touch(tmp_path, "a b/ü☀.png", "r.0.jpg", "no_extension")
    assert names(tmp_path, "./a b/ü☀.png", "a b/ü☀", "r.0", "no_extension") == [
        "a b/ü☀.png",
        "a b/ü☀.png",
        "r.0.jpg",
        "no_extension",
    ]
    assert find_photos(tmp_path, ["a b/ü☀"], SOURCE).notes == ()


@pytest.mark.parametrize(
    "listed", ["images\\0001.jpg", "C:\\Users\\me\\images\\0001.jpg", "/home/me/scene/0001.JPG", "rgb/0001.png", "0001"]
)
def test_paths_of_other_computers_are_found_by_name(tmp_path: Path, listed: str) -> None:
    touch(tmp_path, "images/0001.jpg", "images/0002.jpg")
    found = find_photos(tmp_path, [listed], SOURCE)
    assert found.paths == (tmp_path / "images/0001.jpg",)
    assert len(found.notes) == 1
    assert "1 photo not where listed" in found.notes[0]


def test_ambiguous_names_stay_missing_but_folders_decide(tmp_path: Path) -> None:
    touch(tmp_path, "images/1.jpg", "images_2/1.jpg", "b/2.jpg")
    assert names(tmp_path, "1.jpg", "/elsewhere/2.jpg") == [None, "b/2.jpg"]
    assert names(tmp_path, "/elsewhere/images_2/1.jpg") == ["images_2/1.jpg"]


def test_a_photo_missing_from_its_own_folder_is_not_taken_from_another_split(tmp_path: Path) -> None:
    touch(tmp_path, "train/r_0.png", "test/r_1.png", "test/r_2.png")
    assert names(tmp_path, "train/r_0", "train/r_1", "test/r_2") == ["train/r_0.png", None, "test/r_2.png"]


def test_a_photo_that_another_entry_means_is_not_taken(tmp_path: Path) -> None:
    touch(tmp_path, "test/r_0.png")
    assert names(tmp_path, "train/r_0", "test/r_0") == [None, "test/r_0.png"]
    touch(tmp_path, "new/r_1.png")
    assert names(tmp_path, "x/r_1", "y/r_1", "test/r_0") == [None, None, "test/r_0.png"]


def test_other_extension_in_the_same_folder(tmp_path: Path) -> None:
    touch(tmp_path, "images/1.png", "images/2.jpg")
    assert names(tmp_path, "images/1.jpg", "images/2.jpg") == ["images/1.png", "images/2.jpg"]


def test_missing_photos_are_counted_and_all_missing_is_an_error(tmp_path: Path) -> None:
    touch(tmp_path, "1.png")
    notes = find_photos(tmp_path, ["1.png", "2.png", "3.png"], SOURCE).notes
    assert notes == ("t.json: 2 of 3 listed photos are missing, first '2.png'",)
    with pytest.raises(UserError, match=rf"none of the 2 listed photos exists, tried {tmp_path}/7.png: put"):
        find_photos(tmp_path, ["7.png", "8.png"], SOURCE)


@pytest.mark.parametrize("listed", ["x\0y.png", "\ud800.png", "a" * 5000, "../" * 2000 + "x", "a\nb", "."])
def test_impossible_names_are_missing(tmp_path: Path, listed: str) -> None:
    touch(tmp_path, "1.png")
    assert names(tmp_path, "1.png", listed) == ["1.png", None]
    with pytest.raises(UserError) as caught:
        find_photos(tmp_path, [listed], SOURCE)
    assert "\n" not in str(caught.value)
    str(caught.value).encode()


def test_leaving_the_folder_is_noted_and_devices_are_refused(tmp_path: Path) -> None:
    touch(tmp_path, "out/1.png")
    (tmp_path / "in").mkdir()
    found = find_photos(tmp_path / "in", ["../out/1.png"], SOURCE)
    assert "1 listed photos lie outside of the dataset's folder" in found.notes[0]
    assert ".." not in photo_name(tmp_path / "in", tmp_path / "in/../out/1.png")
    os.mkfifo(tmp_path / "pipe.png")
    for listed in ("pipe.png", os.devnull):
        with pytest.raises(UserError, match="device or a pipe"):
            find_photos(tmp_path, [listed], SOURCE)


def test_a_listed_device_is_refused_by_file_and_entry(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    for entry in ("/dev/zero", "pipe.png"):
        with pytest.raises(
            UserError, match=rf"t\.json: lists '{entry}', a device or a pipe, not a photo: list regular"
        ):
            find_photos(tmp_path, [entry], tmp_path / "t.json")
