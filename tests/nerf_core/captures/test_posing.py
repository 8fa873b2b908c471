"""Structure from motion on small rendered photos, and everything that can go wrong with it."""

from __future__ import annotations

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import poses
import pytest
import textured_photos
from PIL import Image
from searches import FAST, cameras_of, files, of, quiet

from nerf_core.captures import posing, records, search, video_frames
from nerf_core.captures.opening import open_capture
from nerf_core.captures.posing import Posed, find_poses
from nerf_core.captures.raw_photos import RawPhotos, raw_photos
from nerf_core.captures.records import PoseProgress
from nerf_core.common.errors import UserError
from nerf_core.datasets import LoadOptions, load_scene
from nerf_core.geometry.camera import Camera
from nerf_core.geometry.lens import FISHEYE, Lens


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[RawPhotos, Posed, list[PoseProgress]]:
    """Eight photos on an arc, with their poses, and all that was told meanwhile."""
    folder, told = tmp_path_factory.mktemp("arc"), list[PoseProgress]()
    raw = of(textured_photos.write(folder / "photos", textured_photos.arc()))
    return raw, find_poses(raw, folder / "out", FAST, told.append), told


def test_all_photos_get_their_true_poses(found: tuple[RawPhotos, Posed, list[PoseProgress]]) -> None:
    raw, posed, _ = found
    assert posed.unplaced == ()
    assert posed.advice == ""
    cameras = cameras_of(posed)
    truth = np.stack([camera.c2w for camera in textured_photos.arc()])
    turned, moved = poses.errors(np.stack([camera.c2w for camera in cameras]), truth)
    assert turned.max() < 0.5  # degrees
    assert moved.max() < 1.0  # percent of the cameras' spread
    assert cameras[0].fx == pytest.approx(330, rel=0.02)
    assert files(raw.root) == [f"photo {k}.png" for k in range(8)]  # nothing is written beside the photos
    assert files(posed.folder)[0] == "images"
    assert not [name for name in files(posed.folder) if posing.WORK in name]


def test_what_is_done_is_told_while_it_is_done(found: tuple[RawPhotos, Posed, list[PoseProgress]]) -> None:
    _, _, told = found
    stages = list(dict.fromkeys(state.stage for state in told if state.stage))
    assert stages == [records.COPYING, *records.STAGES.values(), records.PLACED]
    assert [photo.shape for photo in told[-1].thumbnails] == [(120, 160, 4)] * 8
    assert (told[-1].placed, told[-1].done) == (8, 8)
    assert told[-1].growing is not None
    assert len(told[-1].growing.poses) == 8
    assert all(0 <= state.done <= state.total for state in told)
    growing = [state.growing for state in told if state.growing is not None]
    assert growing
    assert len(growing[-1].poses) >= 2
    assert len(growing[-1].points) == len(growing[-1].colors) > 50


IMPATIENT = """
import importlib.util, sys
from pathlib import Path
spec = importlib.util.spec_from_file_location("program", {program!r})
program = importlib.util.module_from_spec(spec)
spec.loader.exec_module(program)
program.COUNT_SECONDS = 0.001
program.main(Path(sys.argv[1]))
"""


def test_photos_and_pairs_are_counted_while_colmap_writes_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Counts without a pause meet COLMAP at whatever it does with its database, and nothing fails."""
    (tmp_path / "impatient.py").write_text(IMPATIENT.format(program=str(search.PROGRAM)), "utf-8")
    monkeypatch.setattr(search, "PROGRAM", tmp_path / "impatient.py")
    told = list[PoseProgress]()
    find_poses(
        of(textured_photos.write(tmp_path / "photos", textured_photos.arc())), tmp_path / "out", FAST, told.append
    )
    for stage, total in (("features", 8), ("matches", 28)):
        done = [state.done for state in told if state.stage == records.STAGES[stage]]
        assert done == sorted(done)
        assert done[0] == 0
        assert 0 < done[-1] <= total
        assert len(set(done)) > 2  # it was seen under way


def test_a_videos_poses_may_lie_beside_it(tmp_path: Path) -> None:
    video = tmp_path / "walk.mp4"
    video.write_bytes(b"")
    posing._must_be_free(tmp_path / "poses", RawPhotos(video, tmp_path, (), video))
    with pytest.raises(UserError, match="holds the photos"):
        posing._must_be_free(tmp_path, RawPhotos(video, tmp_path, (), video))
    with pytest.raises(UserError, match="lies among them"):
        posing._must_be_free(tmp_path / "poses", RawPhotos(tmp_path, tmp_path, (tmp_path / "a.jpg",)))


@pytest.mark.thorough(8)
def test_a_second_search_finds_the_same_poses(
    found: tuple[RawPhotos, Posed, list[PoseProgress]], tmp_path: Path
) -> None:
    """A model that was trained on others could not go on."""
    raw, posed, _ = found
    again = find_poses(raw, tmp_path / "again", FAST, quiet)
    for name in ("images.bin", "cameras.bin", "points3D.bin"):
        assert (again.folder / "sparse/0" / name).read_bytes() == (posed.folder / "sparse/0" / name).read_bytes(), name


def test_poses_are_found_again_while_the_photos_stay(
    found: tuple[RawPhotos, Posed, list[PoseProgress]], monkeypatch: pytest.MonkeyPatch
) -> None:
    raw, posed, _ = found
    monkeypatch.setattr(search, "PROGRAM", Path("there is no program"))
    again = find_poses(raw, posed.folder, FAST, quiet)
    assert again.again
    assert (again.names, again.unplaced, again.points) == (posed.names, posed.unplaced, posed.points)
    before = raw.key()
    os.utime(raw.photos[0], (1, 1))
    assert raw.key() != before


def test_the_scene_is_like_one_with_poses(found: tuple[RawPhotos, Posed, list[PoseProgress]]) -> None:
    _, posed, _ = found
    scene = load_scene(posed.folder, LoadOptions())
    assert (len(scene.views), scene.format) == (8, "colmap")
    assert scene.views[0].camera.width == 320


def test_large_photos_get_cameras_of_their_own_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are looked at as smaller copies. One photo is stored on its side, as phones do."""
    monkeypatch.setitem(search.QUALITIES, "fast", (320, 2048, 0))
    folder = textured_photos.write(tmp_path / "large", textured_photos.arc())
    for photo in folder.iterdir():
        with Image.open(photo) as image:
            large = image.resize((640, 480), Image.Resampling.LANCZOS)
        photo.unlink()
        exif = Image.Exif()
        if photo.stem == "photo 3":
            large, exif[0x0112] = large.transpose(Image.Transpose.ROTATE_90), 6
        large.save(photo.with_suffix(".jpg"), quality=95, exif=exif)
    posed = find_poses(of(folder), tmp_path / "out", FAST, quiet)
    assert posed.unplaced == ()
    assert {(camera.width, camera.height) for camera in cameras_of(posed)} == {(640, 480)}
    assert cameras_of(posed)[0].fx == pytest.approx(2 * 330, rel=0.02)
    scene = load_scene(posed.folder, LoadOptions(downscale=2))
    shown = scene.photos.images[3] / 257 - textured_photos.picture(textured_photos.arc()[3])
    assert np.abs(shown).mean() < 20  # on its side it would be some 60


def test_many_photos_are_matched_with_those_that_resemble_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "ALL_PAIRS", 4)
    monkeypatch.setattr(search, "NEAR", 3)
    folder, pairs = textured_photos.write(tmp_path / "many", textured_photos.arc()), set[int]()
    posed = find_poses(of(folder), tmp_path / "out", FAST, lambda s: pairs.add(s.total) if "match" in s.stage else None)
    assert posed.unplaced == ()
    assert max(pairs) < 8 * 7 / 2


@pytest.mark.thorough(5)
def test_a_video_is_read_where_the_camera_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video_frames, "FEWEST", 10)
    monkeypatch.setattr(video_frames, "MOST", 12)
    video = tmp_path / "film.mp4"
    moving = [textured_photos.picture(camera) for camera in textured_photos.arc(30)]
    pictures = [*moving[:15], *[moving[15]] * 40, *moving[15:]]  # it stands still for a while
    ten_bits = ["-pix_fmt", "yuv420p10le"]  # as phones film in HDR
    imageio.mimwrite(video, pictures, fps=15, quality=9, macro_block_size=1, output_params=ten_bits)  # pyright: ignore[reportCallIssue, reportArgumentType]: the stubs lack the options of ffmpeg
    posed = find_poses(of(video), None, FAST, quiet)
    assert 8 <= len(posed.names) <= 12
    assert not posed.unplaced
    assert sum(15 <= int(name[6:12]) < 55 for name in posed.names) <= 2
    assert files(tmp_path / "cache")
    monkeypatch.setattr(search, "PROGRAM", Path("there is no program"))
    scene = open_capture(video, LoadOptions(poses="fast"))  # found again
    assert (scene.name, scene.format) == ("film", "colmap")


@pytest.mark.parametrize(
    ("cameras", "seeds", "words"),
    [
        (textured_photos.arc(around=False, degrees=60), None, "turned on the spot"),
        (textured_photos.arc(), list(range(8)), "do not show enough of the same"),
        (textured_photos.arc(2), None, "2 photos: at least 3"),
    ],
)
def test_bad_captures_are_told_what_to_photograph(
    tmp_path: Path, cameras: list[Camera], seeds: list[int] | None, words: str
) -> None:
    folder = textured_photos.write(tmp_path / "bad", cameras, seeds)
    with pytest.raises(UserError, match=words):
        find_poses(of(folder), tmp_path / "out", FAST, quiet)
    assert not (tmp_path / "out").exists()


def test_a_masked_subject_has_no_features(tmp_path: Path) -> None:
    """In front of a still scene a textured sheet moves with the camera: without masks the sheet is what fits."""
    home = textured_photos.write(tmp_path / "some" / "images", textured_photos.arc()).parent
    sheet = np.kron(np.random.default_rng(3).integers(0, 256, (22, 30, 3), np.uint8), np.ones((5, 5, 1), np.uint8))
    (home / "masks").mkdir()
    for k, photo in enumerate(sorted((home / "images").iterdir())):
        with Image.open(photo) as image:
            pixels = np.array(image)
        top, left = 60 + 6 * (k % 2), 60
        pixels[top : top + 110, left : left + 150] = sheet
        mask = np.full(pixels.shape[:2], 255, np.uint8)
        mask[top : top + 110, left : left + 150] = 0
        Image.fromarray(pixels).save(photo)
        if k != 7:  # one photo without a mask is used whole
            Image.fromarray(mask).save(home / "masks" / f"{photo.stem}.png")
    raw = of(home)
    posed = find_poses(raw, tmp_path / "out", FAST, quiet)
    assert posed.unplaced == ()
    assert cameras_of(posed)[0].fx == pytest.approx(330, rel=0.05)  # with the sheet it is some 110
    _, moved = poses.errors(
        np.stack([camera.c2w for camera in cameras_of(posed)]), np.stack([c.c2w for c in textured_photos.arc()])
    )
    assert moved.max() < 3.0  # percent; with the sheet some 14
    before = raw.key()
    os.utime(home / "masks" / "photo 0.png", (1, 1))
    assert raw.key() != before  # other masks give other poses


def test_fisheye_photos_get_their_poses(tmp_path: Path) -> None:
    """83° to each side, through a lens that bends; taken for perspective, they are some 8° and 10 % wrong."""
    lens = Lens(k1=0.03, k2=-0.01, kind=FISHEYE)
    cameras = [replace(camera, fx=110.0, fy=110.0, lens=lens) for camera in textured_photos.arc()]
    (tmp_path / "photos").mkdir()
    for k, camera in enumerate(cameras):
        Image.fromarray(textured_photos.picture(camera, cells=6)).save(tmp_path / "photos" / f"photo {k}.png")
    options = replace(FAST, lens="fisheye")
    posed = find_poses(of(tmp_path / "photos"), tmp_path / "out", options, quiet)
    assert posed.unplaced == ()
    found = cameras_of(posed)
    assert found[0].lens.kind == FISHEYE
    turned, moved = poses.errors(np.stack([c.c2w for c in found]), np.stack([c.c2w for c in cameras]))
    assert turned.max() < 2.0
    assert moved.max() < 2.0
    raw = of(tmp_path / "photos")
    assert posing.pose_folder(raw, options) != posing.pose_folder(raw, FAST)


def test_lost_and_damaged_photos_are_told_with_the_reason(tmp_path: Path) -> None:
    folder = textured_photos.write(tmp_path / "some", textured_photos.arc())
    Image.fromarray(textured_photos.picture(textured_photos.arc()[0], seed=9)).save(folder / "stranger.png")
    Image.new("RGB", textured_photos.SIZE, (90, 90, 90)).save(folder / "wall.png")
    (folder / "broken.jpg").write_bytes(b"no photo")
    posed = find_poses(of(folder), tmp_path / "out", FAST, quiet)
    reasons = dict(posed.unplaced)
    assert "too little of what the others show" in reasons["stranger.png"]
    assert "without texture" in reasons["wall.png"]
    assert reasons["broken.jpg"] == "it cannot be read"
    (first, *_) = posed.notes
    assert first.startswith("8 of 11 photos have a pose")
    counts = [note for note in open_capture(folder, LoadOptions(poses="fast")).notes if " of " in note]
    assert len(counts) == 1  # what each lacks says more than how many are registered
    assert counts[0].startswith("8 of 11 photos have a pose")
    assert any("8 of the 11 photos in" in note for note in load_scene(tmp_path / "out", LoadOptions()).notes)


def test_photos_of_all_kinds_keep_names_masks_and_the_way_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name that is not UTF-8, a photo that lies upside down, one of another size, a mask, and a link to nowhere."""
    monkeypatch.chdir(tmp_path)
    folder = textured_photos.write(tmp_path / "kinds" / "images", textured_photos.arc())
    os.rename(folder / "photo 0.png", os.fsencode(folder) + b"/caf\xe9.png")
    with Image.open(folder / "photo 5.png") as image:
        exif = Image.Exif()
        exif[0x0112] = 3
        image.transpose(Image.Transpose.ROTATE_180).save(folder / "photo 5.jpg", quality=95, exif=exif)
    (folder / "photo 5.png").unlink()
    with Image.open(folder / "photo 6.png") as image:
        image.resize((480, 360), Image.Resampling.LANCZOS).save(folder / "photo 6.png")
    masks = folder.parent / "masks"
    masks.mkdir()
    mask = np.full(textured_photos.SIZE[::-1], 255, np.uint8)
    mask[:60] = 0
    Image.fromarray(mask).save(masks / "photo 1.png")
    (folder / "photo 9.png").symlink_to(tmp_path / "nowhere")
    (folder / "photo 1.mask.png").symlink_to(masks / "photo 1.png")
    scene = open_capture(Path("kinds"), LoadOptions(poses="fast"))
    names = [view.name for view in scene.views]
    assert names == ["images/caf\\xe9.png", *(f"images/photo {k}.png" for k in (1, 2, 3, 4)), "images/photo 5.jpg",
                     "images/photo 6.png", "images/photo 7.png"]  # fmt: skip
    shown = scene.photos.images[5] / 257 - textured_photos.picture(textured_photos.arc()[5])
    assert np.abs(shown).mean() < 20
    assert list(scene.photos.masked_photos) == [1]
    (small, large) = (scene.views[k].camera for k in (4, 6))
    assert large.fx == pytest.approx(1.5 * small.fx, rel=0.05)


class TestRawPhotos:
    def test_a_folder_of_captures_is_none(
        self, tmp_path: Path, found: tuple[RawPhotos, Posed, list[PoseProgress]]
    ) -> None:
        textured_photos.write(tmp_path / "other", textured_photos.arc(3))
        (tmp_path / "posed").symlink_to(found[1].folder)
        assert raw_photos(tmp_path) is None

    def test_a_capture_with_poses_is_none(self, found: tuple[RawPhotos, Posed, list[PoseProgress]]) -> None:
        assert raw_photos(found[1].folder) is None
        assert raw_photos(None) is None

    def test_photos_may_lie_in_a_folder_below(self, tmp_path: Path) -> None:
        for folder in ("images", "images_4", "other"):
            textured_photos.write(tmp_path / folder, textured_photos.arc(3))
        assert of(tmp_path).root == tmp_path / "images"
        assert len(of(tmp_path).photos) == 3

    def test_one_video_is_taken_and_two_are_asked_about(self, tmp_path: Path) -> None:
        (tmp_path / "a.mp4").write_bytes(b"")
        assert of(tmp_path).video == tmp_path / "a.mp4"
        (tmp_path / "b.MOV").write_bytes(b"")
        with pytest.raises(UserError, match="2 videos"):
            raw_photos(tmp_path)

    @pytest.mark.parametrize("kind", ["none", "empty", "without its index", "sound alone", "one frame"])
    def test_a_broken_video_is_named(self, kind: str, tmp_path: Path) -> None:
        video, words = tmp_path / "a.mp4", "a.mp4 cannot be read as a video: it is damaged or has no pictures"
        source = "sine" if kind == "sound alone" else "testsrc2=size=64x48:rate=8"
        frames = 1 if kind == "one frame" else 8
        command = f"-v error -f lavfi -i {source} -t 1 -frames:v {frames} a.mp4"
        subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *command.split()], cwd=tmp_path, check=True)
        if kind == "without its index":  # which comes last: as of a camera whose battery fell out
            video.write_bytes(video.read_bytes().partition(b"moov")[0])
        elif kind in ("none", "empty"):
            video.write_bytes(b"no video" if kind == "none" else b"")
        elif kind == "one frame":
            words = "a.mp4 has 1 frame: photograph from many sides"
        with pytest.raises(UserError, match=words) as found:
            find_poses(of(tmp_path), None, FAST, quiet)
        assert "\n" not in str(found.value)
