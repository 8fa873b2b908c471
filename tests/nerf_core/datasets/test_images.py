import io
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms, ImageOps

from nerf_core.common.errors import UserError
from nerf_core.datasets.images import MAX_PIXELS, UnreadableError, damage_notes, measure, read_photo
from nerf_core.datasets.resample import srgb_encoded

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


def read(path: Path, background: tuple[float, float, float] = BLACK) -> np.ndarray:
    header = measure(path)
    return read_photo(path, (header.width, header.height), background)


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def write_deep_png(path: Path, pixels: np.ndarray) -> None:
    """Write (H, W, 1…4) as a 16-bit PNG, which Pillow cannot write in colour. The rows use PNG's Sub filter."""
    height, width, channels = pixels.shape
    raw = pixels.astype(">u2").view(np.uint8).reshape(height, -1)
    step = 2 * channels
    filtered = raw.copy()
    filtered[:, step:] -= raw[:, :-step]
    rows = b"".join(b"\x01" + row.tobytes() for row in filtered)
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    chunks = png_chunk(b"IHDR", header) + png_chunk(b"IDAT", zlib.compress(rows)) + png_chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_are_kept_exactly(tmp_path: Path, channels: int) -> None:
    pixels = np.random.default_rng(channels).integers(0, 65536, (5, 7, channels), dtype=np.uint16)
    if channels in (2, 4):
        pixels[..., -1] = 65535
    write_deep_png(tmp_path / "deep.png", pixels)
    color = pixels[..., :1] if channels <= 2 else pixels[..., :3]
    assert np.array_equal(read(tmp_path / "deep.png"), np.broadcast_to(color, (5, 7, 3)))


def test_palette_with_a_transparent_entry(tmp_path: Path) -> None:
    image = Image.new("P", (2, 1))
    image.putpalette([10, 20, 30, 200, 100, 50])
    image.putdata([0, 1])
    image.save(tmp_path / "p.png", transparency=1)
    assert measure(tmp_path / "p.png").alpha
    assert (read(tmp_path / "p.png", WHITE) // 257).tolist() == [[[10, 20, 30], [255, 255, 255]]]


def test_grey_with_alpha(tmp_path: Path) -> None:
    Image.fromarray(np.array([[[80, 255], [80, 0]]], np.uint8), "LA").save(tmp_path / "la.png")
    assert (read(tmp_path / "la.png", WHITE) // 257).tolist() == [[[80] * 3, [255] * 3]]


def test_cmyk_is_converted(tmp_path: Path) -> None:
    Image.new("CMYK", (8, 8), (0, 255, 255, 0)).save(tmp_path / "red.jpg", quality=100)
    red = read(tmp_path / "red.jpg")[4, 4] / 65535
    assert red[0] > 0.95
    assert red[1:].max() < 0.05


def display_p3() -> bytes:
    """A Display P3 profile (its primaries adapted to D50) with the pure power curve γ = 2.2."""

    def fixed(*values: float) -> bytes:
        return b"".join(struct.pack(">i", round(v * 65536)) for v in values)

    text = b"P3 for a test\0"
    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(2.2 * 256)) + bytes(2)
    tags = {
        b"desc": b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(12 + 67),
        b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1, 0.8249),
        b"rXYZ": b"XYZ " + bytes(4) + fixed(0.51512, 0.24120, -0.00105),
        b"gXYZ": b"XYZ " + bytes(4) + fixed(0.29198, 0.69225, 0.04189),
        b"bXYZ": b"XYZ " + bytes(4) + fixed(0.15710, 0.06657, 0.78407),
        b"rTRC": curve,
        b"gTRC": curve,
        b"bTRC": curve,
    }
    table, body, offset = b"", b"", 128 + 4 + 12 * len(tags)
    for name, data in tags.items():
        padded = data + bytes(-len(data) % 4)
        table += name + struct.pack(">II", offset + len(body), len(data))
        body += padded
    head = struct.pack(">I4sI4s4s4s", 0, bytes(4), 0x02100000, b"mntr", b"RGB ", b"XYZ ") + bytes(12) + b"acsp"
    head += bytes(28) + fixed(0.9642, 1, 0.8249)
    profile = head + bytes(128 - len(head)) + struct.pack(">I", len(tags)) + table + body
    return struct.pack(">I", len(profile)) + profile[4:]


def test_colour_profile_is_converted_to_srgb(tmp_path: Path) -> None:
    p3 = np.array([[200, 110, 100], [60, 140, 90], [128, 128, 128]], np.uint8)
    Image.fromarray(p3[None]).save(tmp_path / "p3.png", icc_profile=display_p3())
    to_xyz = np.array([[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]])
    srgb_to_xyz = np.array(
        [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
    )
    linear = (p3 / 255) ** 2.2 @ to_xyz.T @ np.linalg.inv(srgb_to_xyz).T
    expected = srgb_encoded(linear) * 255
    assert np.abs(expected - p3)[0].max() > 8  # the conversion changes some colours by more than 8 levels
    assert np.abs(read(tmp_path / "p3.png")[0] / 257 - expected).max() < 2


def test_srgb_profile_changes_nothing_and_a_broken_one_is_damage(tmp_path: Path) -> None:
    pixels = np.random.default_rng(3).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(pixels).save(tmp_path / "s.png", icc_profile=srgb)
    assert np.array_equal(read(tmp_path / "s.png"), pixels.astype(np.uint16) * 257)
    Image.fromarray(pixels).save(tmp_path / "b.png", icc_profile=b"no profile at all")
    with pytest.raises(UnreadableError, match="profile is broken"):
        read(tmp_path / "b.png")


def write_exr(path: Path, straight: np.ndarray) -> None:
    """(H, W, 4) straight linear float32 → EXR, by ffmpeg (which stores it premultiplied)."""
    import imageio_ffmpeg

    height, width = straight.shape[:2]
    planes = np.stack([straight[..., c] for c in (1, 2, 0, 3)]).astype(np.float32)
    command = f"-v error -y -f rawvideo -pix_fmt gbrapf32le -s {width}x{height} -i - -frames:v 1 -format float"
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *command.split(), str(path)], input=planes.tobytes(), check=True)


def test_exr_is_linear_and_premultiplied(tmp_path: Path) -> None:
    straight = np.random.default_rng(4).random((3, 5, 4)).astype(np.float32) * 0.9 + 0.1
    straight[0, 0] = (4, 2, 1, 1)  # brighter than white
    write_exr(tmp_path / "light ☀.exr", straight)
    assert measure(tmp_path / "light ☀.exr").alpha
    alpha = straight[..., 3:]
    expected = srgb_encoded(straight[..., :3]) * alpha + (1 - alpha)
    np.testing.assert_allclose(read(tmp_path / "light ☀.exr", WHITE) / 65535, expected, atol=2e-4)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_follows_exif(tmp_path: Path, orientation: int) -> None:
    pixels = np.random.default_rng(5).integers(0, 256, (3, 5, 3), dtype=np.uint8)
    image = Image.fromarray(pixels)
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(tmp_path / "turned.png", exif=exif)
    assert measure(tmp_path / "turned.png").orientation == orientation
    with Image.open(tmp_path / "turned.png") as opened:
        expected = np.asarray(ImageOps.exif_transpose(opened))
    upright = read_photo(tmp_path / "turned.png", (expected.shape[1], expected.shape[0]), BLACK, upright=True)
    assert np.array_equal(upright // 257, expected)
    assert np.array_equal(read(tmp_path / "turned.png") // 257, pixels)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.webp", "a.tif", "a.exr"])
def test_a_file_that_is_no_picture_is_damaged(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"")
    with pytest.raises(UnreadableError, match=name):
        measure(path)
    path.write_bytes(b"<!DOCTYPE html><html></html>")
    with pytest.raises(UnreadableError, match=name):
        measure(path)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_truncated_photos_are_damage(tmp_path: Path, kind: str) -> None:
    buffer = io.BytesIO()
    Image.fromarray(np.random.default_rng(6).integers(0, 256, (64, 64, 3), dtype=np.uint8)).save(buffer, kind)
    whole = buffer.getvalue()
    for cut in range(1, len(whole) // 2, len(whole) // 16):
        path = tmp_path / f"{cut}.img"
        path.write_bytes(whole[:cut])
        with pytest.raises(UnreadableError, match=path.name):
            read(path)


def test_bombs_devices_and_missing_files_are_refused(tmp_path: Path) -> None:
    side = int(MAX_PIXELS**0.5) + 9
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    chunks = png_chunk(b"IHDR", header) + png_chunk(b"IDAT", zlib.compress(b"\0")) + png_chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    with pytest.raises(UserError, match=r"bomb.png claims .*million pixels"):
        measure(tmp_path / "bomb.png")
    os.mkfifo(tmp_path / "pipe.png")
    for path in (tmp_path / "pipe.png", Path(os.devnull), tmp_path):
        with pytest.raises(UserError, match="device, pipe or folder"):
            measure(path)
    with pytest.raises(UnreadableError, match="No such file"):
        measure(tmp_path / "none.png")


def test_damage_notes() -> None:
    assert damage_notes([]) == ()
    assert damage_notes(["x: cut"]) == ("1 damaged photo is skipped, first x: cut",)
    assert damage_notes(["x: cut", "y"]) == ("2 damaged photos are skipped, first x: cut",)


def test_heic_is_read_where_its_package_is_installed(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    pixels = np.tile(np.linspace(20, 230, 64).astype(np.uint8)[:, None, None], (1, 48, 3))
    Image.fromarray(pixels).save(tmp_path / "a.heic", quality=95)
    assert (measure(tmp_path / "a.heic").width, measure(tmp_path / "a.heic").height) == (48, 64)
    np.testing.assert_allclose(read(tmp_path / "a.heic") / 257, pixels, atol=4)
    data = (tmp_path / "a.heic").read_bytes()
    for cut in (0, 20, len(data) // 2, len(data) - 8):
        (tmp_path / "a.heic").write_bytes(data[:cut])
        with pytest.raises(UnreadableError) as caught:
            read(tmp_path / "a.heic")
        assert "\n" not in str(caught.value)


def test_heic_without_its_package_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.HEIC").write_bytes(b"....ftypheic")
    with pytest.raises(
        UserError, match=r"a\.HEIC is an HEIC photo: to read it, run `pip install 'nerf-viewer\[heic\]'`"
    ):
        measure(tmp_path / "a.HEIC")
