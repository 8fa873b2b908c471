"""What a file claims is compared with what it holds, and a large one is read within stated memory and time."""

import json
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms, ImageOps, TiffImagePlugin

from nerf_core.common.errors import UserError
from nerf_core.common.json_files import read_json
from nerf_core.datasets import load_scene
from nerf_core.datasets.capture import LoadOptions
from nerf_core.datasets.exr import MAGIC
from nerf_core.datasets.images import UnreadableError, measure, read_photo
from nerf_core.datasets.resample import composite

# A process that has loaded the reader, and reads each photo in a child of its own: the peak is then the photo's alone.
PEAKS = """
import os
import sys
from pathlib import Path
from nerf_core.datasets.images import read_photo

def peak():  # getrusage would begin with the peak of the process that started this one
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1])

for line in sys.stdin:
    side, path = line.rstrip("\\n").split(" ", 1)
    if (child := os.fork()) == 0:
        before = peak()
        pixels = read_photo(Path(path), (int(side), int(side)), (0, 0, 0))
        assert pixels.shape[0] == int(side)
        print(peak() - before, flush=True)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        print("failed", flush=True)
"""
PeakMb = Callable[[Path, int], float]


@pytest.fixture(scope="module")
def peak_mb() -> Iterator[PeakMb]:
    """A function that tells how many MiB reading a photo adds to the peak of a new process."""
    if not Path("/proc/self/status").exists():
        pytest.skip("only Linux tells the peak of a process")
    with subprocess.Popen(
        [sys.executable, "-c", PEAKS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as reader:
        assert reader.stdin is not None
        assert reader.stdout is not None
        given, told = reader.stdin, reader.stdout

        def ask(path: Path, side: int) -> float:
            given.write(f"{side} {path}\n")
            given.flush()
            answer = told.readline().strip()
            assert answer.isdigit(), f"{path}: the reader says {answer!r}"
            return int(answer) / 1024

        yield ask
        given.close()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(path: Path, side: int, data: bytes, depth: int = 8) -> Path:
    header = struct.pack(">IIBBBBB", side, side, depth, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b""))
    return path


def test_a_large_photo_takes_under_a_gigabyte(tmp_path: Path, peak_mb: PeakMb) -> None:
    side = 14_100
    packer = zlib.compressobj(1)
    row = b"\0" + bytes(range(1, 4)) * side
    data = b"".join(packer.compress(row) for _ in range(side)) + packer.flush()
    assert peak_mb(png(tmp_path / "large.png", side, data), 800) < 1000


def photo(folder: Path, kind: str, side: int) -> Path:
    """Write a photo of a kind: a format, a pixel type, and what else matters."""
    form, mode, *more = kind.split(" ")
    path = folder / f"a.{form}"
    if mode == "RGB16":
        packer = zlib.compressobj(1)
        row = b"\0" + bytes(range(6)) * side
        return png(path, side, b"".join(packer.compress(row) for _ in range(side)) + packer.flush(), depth=16)
    pixels = np.random.default_rng(0).integers(0, 256, (side // 8, side // 8, 4), dtype=np.uint8)
    image = Image.fromarray(pixels.repeat(8, 0).repeat(8, 1))
    if mode == "I;16":
        image = Image.fromarray(np.asarray(image)[..., 0].astype(np.uint16) << 8)
    elif mode == "P":
        image = Image.fromarray(np.asarray(image)[..., 0])
        image.putpalette(list(range(256)) * 3)
    else:
        image = image.convert("RGB").convert(mode) if mode not in ("RGBA", "LA") else image.convert(mode)
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    options: dict[str, dict[str, Any]] = {
        "transparent": {"transparency": 0},
        "profile": {"icc_profile": profile.replace("sRGB".encode("utf-16-be"), "mine".encode("utf-16-be"))},
        "progressive": {"progressive": True},
        "sampled": {"subsampling": 0},
        "strip": {"compression": "tiff_lzw", "tiffinfo": {TiffImagePlugin.ROWSPERSTRIP: side}},
    }
    image.save(path, **{name: value for word in more for name, value in options[word].items()})
    return path


KINDS = ("png 1", "png L", "png P", "png P transparent", "png I;16", "png LA", "png RGB", "png RGB profile", "png RGBA")
KINDS += ("png RGB16", "jpg L", "jpg RGB", "jpg CMYK", "jpg RGB progressive", "jpg RGB progressive sampled")
KINDS += ("webp RGB", "webp RGBA", "tiff RGB", "tiff RGB strip", "bmp L")


LARGE = [
    pytest.param(kind, 4000, marks=pytest.mark.thorough(3)) for kind in ("png L", "png RGB16", "jpg RGB", "webp RGBA")
]  # in their own size


@pytest.mark.parametrize(("kind", "wanted"), [*((kind, 400) for kind in KINDS), *LARGE])
def test_a_photo_takes_the_memory_that_is_counted(tmp_path: Path, peak_mb: PeakMb, kind: str, wanted: int) -> None:
    side = 4000
    path = photo(tmp_path, kind, side)
    counted, taken = measure(path).memory.peak((side, side), (wanted, wanted)) / 2**20, peak_mb(path, wanted)
    assert taken < counted < 1.4 * taken + 50  # MiB: the float rows in work may take that less


def test_only_rows_in_work_are_copied(tmp_path: Path, peak_mb: PeakMb) -> None:
    """Pillow's picture has 4 bytes a pixel, two of them have 8; as arrays they took 10 to 23."""
    for kind, size in {"png P transparent": 1, "jpg RGB": 4, "png RGB profile": 4, "png RGB16": 8}.items():
        assert peak_mb(photo(tmp_path, kind, 4000), 100) < (size + 1.5) * 4000**2 / 2**20


def test_a_png_that_cannot_hold_its_pixels_is_damaged(tmp_path: Path) -> None:
    path = png(tmp_path / "hollow.png", 14_000, zlib.compress(bytes(1000)))
    with pytest.raises(UnreadableError, match=r"hollow\.png: claims 14000×14000 pixels, which its \d+ bytes cannot"):
        measure(path)


def test_the_best_compressed_png_is_no_damage(tmp_path: Path) -> None:
    for mode in ("1", "L", "P", "RGB", "RGBA", "LA", "I;16"):
        Image.new(mode, (3000, 3000)).save(tmp_path / "flat.png", compress_level=9)
        assert measure(tmp_path / "flat.png").width == 3000
    Image.new("L", (3000, 3000)).save(tmp_path / "flat.jpg", progressive=True, optimize=True)
    assert measure(tmp_path / "flat.jpg").width == 3000


def test_a_tiff_or_bmp_that_cannot_hold_its_pixels_is_damaged(tmp_path: Path) -> None:
    width = (123).to_bytes(2, "little")
    for name in ("hollow.tiff", "hollow.bmp"):
        path = tmp_path / name
        Image.new("RGB", (123, 20)).save(path)
        data = bytearray(path.read_bytes())
        at = data.index(width, 8)  # where the header has the width
        data[at : at + len(width)] = (30_000).to_bytes(2, "little")
        path.write_bytes(data)
        with pytest.raises(UnreadableError, match=r"claims 30000×20 pixels, which its [\d,]+ bytes cannot hold"):
            measure(path)


def test_the_best_compressed_tiff_or_bmp_is_no_damage(tmp_path: Path) -> None:
    for compression in ("raw", "packbits", "tiff_lzw", "tiff_adobe_deflate", "tiff_deflate"):
        for mode in ("1", "L", "P", "RGB", "RGBA", "I;16"):
            Image.new(mode, (3000, 3000)).save(tmp_path / "flat.tiff", compression=compression)
            assert measure(tmp_path / "flat.tiff").width == 3000
    for mode in ("1", "L", "P", "RGB", "RGBA"):
        Image.new(mode, (3000, 3000)).save(tmp_path / "flat.bmp")
        assert measure(tmp_path / "flat.bmp").width == 3000


def exr(path: Path, side: int, size: int, compression: int = 3) -> Path:
    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    channels = b"".join(name + b"\0" + struct.pack("<4i", 1, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, side - 1, side - 1)
    head = MAGIC + struct.pack("<i", 2) + attribute(b"channels", b"chlist", channels)
    head += attribute(b"compression", b"compression", bytes([compression]))
    head += attribute(b"dataWindow", b"box2i", window) + attribute(b"displayWindow", b"box2i", window) + b"\0"
    path.write_bytes(head.ljust(size, b"\0"))
    return path


def test_an_exr_that_cannot_hold_its_pixels_is_damaged(tmp_path: Path) -> None:
    with pytest.raises(UnreadableError, match="claims 14000×14000 pixels, which its 500,000 bytes cannot hold"):
        measure(exr(tmp_path / "hollow.exr", 14_000, 500_000))
    with pytest.raises(UnreadableError, match="cannot hold"):
        measure(exr(tmp_path / "raw.exr", 1000, 5_000_000, compression=0))
    with pytest.raises(UserError, match=r"claims 64 million pixels, 50 are allowed"):
        measure(exr(tmp_path / "huge.exr", 8000, 500_000))


def test_large_photos_keep_their_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (90, 70, 4), dtype=np.uint8)
    for name, image in {"a.png": Image.fromarray(pixels), "b.png": Image.fromarray(pixels[..., :3])}.items():
        image.save(tmp_path / name)
        whole = read_photo(tmp_path / name, (31, 40), (1, 0, 0))
        with monkeypatch.context() as patch:
            patch.setattr("nerf_core.datasets.images.HEAVY_BYTES", 0)
            patch.setattr("nerf_core.datasets.resample.BAND_BYTES", 1)
            np.testing.assert_array_equal(read_photo(tmp_path / name, (31, 40), (1, 0, 0)), whole)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_photo_is_turned_strip_by_strip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, orientation: int
) -> None:
    monkeypatch.setattr("nerf_core.datasets.resample.ROWS_AT_ONCE", 1)
    monkeypatch.setattr("nerf_core.datasets.resample.PIXELS_AT_ONCE", 1)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    pixels = np.random.default_rng(0).integers(0, 256, (30, 20, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    with Image.open(tmp_path / "a.png") as image:
        turned = np.asarray(ImageOps.exif_transpose(image))
    for height, width in (turned.shape[:2], (7, 5)):
        expected = composite(turned, (width, height), (0, 0, 0))
        found = read_photo(tmp_path / "a.png", (width, height), (0, 0, 0), upright=True)
        np.testing.assert_array_equal(found, expected)


def test_a_large_jpeg_is_decoded_near_the_wanted_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ramp = np.broadcast_to(np.linspace(0, 255, 640)[:, None, None], (640, 640, 3)).astype(np.uint8)
    Image.fromarray(ramp).save(tmp_path / "a.jpg", quality=95)
    whole = read_photo(tmp_path / "a.jpg", (80, 80), (0, 0, 0)).astype(float)
    monkeypatch.setattr("nerf_core.datasets.images.HEAVY_BYTES", 0)
    sizes = []
    load = Image.Image.crop
    monkeypatch.setattr(Image.Image, "crop", lambda image, box: sizes.append(image.size) or load(image, box))
    assert abs(read_photo(tmp_path / "a.jpg", (80, 80), (0, 0, 0)) - whole).max() < 2 * 257
    assert set(sizes) == {(160, 160)}


@pytest.mark.parametrize("filling", ["[],", "0,", '{"a":[', "[[]],"])
def test_a_json_of_empty_lists_is_refused_before_it_is_parsed(tmp_path: Path, filling: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text('{"frames": [' + filling * (20_000_000 // len(filling)) + "0]}")
    start = time.perf_counter()
    with pytest.raises(UserError, match=r"holds about [\d,]+ values, 2,000,000 are allowed"):
        read_json(path)
    assert time.perf_counter() - start < 1


def test_ten_thousand_frames_are_no_damage(tmp_path: Path) -> None:
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()} | {f"k{i}": 0.5 for i in range(16)}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame] * 10_000}))
    assert len(read_json(tmp_path / "transforms.json").children("frames")) == 10_000


@pytest.mark.parametrize("size", [(1, 1_000_000), (1_000_000, 1)])
def test_a_narrow_photo_is_averaged_in_time(size: tuple[int, int]) -> None:
    rows = np.broadcast_to(np.array([[[0, 100, 200]]], np.uint8), (size[1], size[0], 3))
    start = time.process_time()
    found = composite(rows, (min(size[0], 800), min(size[1], 800)), (0, 0, 0))
    whole = composite(rows, size, (0, 0, 0))
    assert time.process_time() - start < 5  # it took 15 s
    assert (found // 257 == [0, 100, 200]).all()
    assert (whole // 257 == [0, 100, 200]).all()


def test_a_fault_of_ours_is_not_called_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise IndexError("a fault of ours")

    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    monkeypatch.setattr("nerf_core.datasets.images.composite", broken)
    with pytest.raises(IndexError, match="a fault of ours"):
        read_photo(tmp_path / "a.png", (4, 4), (0, 0, 0))


def test_photos_of_eight_bits_are_kept_in_eight(transforms_folder: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = transforms_folder
    scene, small = load_scene(folder, LoadOptions()), load_scene(folder, LoadOptions(downscale=2))
    assert (scene.photos.flat.dtype, small.photos.flat.dtype) == (np.uint8, np.uint16)
    paths = sorted(folder.glob("**/*.png"))
    for view, image in zip(scene.views, scene.images, strict=True):
        (path,) = (path for path in paths if path.name == Path(view.name).name)
        size = image.shape[1], image.shape[0]
        np.testing.assert_array_equal(image, read_photo(path, size, scene.background, upright=True))


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "CMYK", "YCbCr", "LA", "RGBA", "I;16"])
def test_what_is_said_to_have_eight_bits_has_no_more(tmp_path: Path, mode: str) -> None:
    rng = np.random.default_rng(1)
    image = Image.fromarray(rng.integers(0, 256, (9, 11, 3), dtype=np.uint8))
    if mode == "I;16":
        image = Image.fromarray(rng.integers(0, 65536, (9, 11), dtype=np.uint16))
    elif mode in ("LA", "RGBA"):
        image.putalpha(Image.fromarray(rng.integers(0, 256, (9, 11), dtype=np.uint8)))
        image = image.convert(mode)
    else:
        image = image.convert(mode)
    for suffix in ("png", "tiff", "jpg", "webp", "bmp"):
        path = tmp_path / f"a.{suffix}"
        try:
            image.save(path)
        except (OSError, ValueError):  # the format has no such pixels
            continue
        if measure(path).eight_bits:
            assert (read_photo(path, (11, 9), (0, 0, 0)) % 257 == 0).all()
        else:
            assert mode in ("LA", "RGBA", "I;16")


def test_a_photo_that_takes_more_memory_than_allowed_is_refused(tmp_path: Path) -> None:
    frame = {"file_path": "a.webp", "transform_matrix": np.eye(4).tolist()}
    document = {"fl_x": 9000.0, "cx": 6000.0, "cy": 6000.0, "w": 12_000, "h": 12_000, "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    bits = (1 << 28) | (11_999 << 14) | 11_999  # alpha is used; the sizes less one
    body = b"\x2f" + struct.pack("<I", bits) + bytes([0x88, 0x88, 0x08])
    chunk = b"VP8L" + struct.pack("<I", len(body)) + body
    chunk += b"\0" * (len(body) % 2)
    (tmp_path / "a.webp").write_bytes(b"RIFF" + struct.pack("<I", 4 + len(chunk)) + b"WEBP" + chunk)
    with pytest.raises(
        UserError, match=r"a\.webp: decoding its 12000×12000 pixels takes 2\.5 GB, --memory-gb allows 1"
    ):
        load_scene(tmp_path, LoadOptions(memory_gb=1, max_size=100))
