"""The drawn pixels: imgui's draw lists, the preview, its warp, and lines in space."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import scripted
from imgui_bundle import ImVec2, ImVec4, imgui
from panel_states import bare_ray, make_camera, make_ray

from nerf_core.geometry.camera import Camera
from nerf_core.live.messages import Preview, ViewRequest
from viewer.draw.imgui_renderer import ImguiRenderer
from viewer.draw.overlays import Box, Overlay, axis_directions, clear_of, clip_segments, frusta, uncovered
from viewer.draw.textures import TextureCache
from viewer.draw.viewport import ViewportPicture
from viewer.draw.visits import Ink
from viewer.draw.warp import Layer
from viewer.draw.warp_mesh import BESIDE, MESH_CELLS, SHEET_CELLS, SMOOTH, SOFT, sheet, warp_mesh
from viewer.window import Window

BLACK = (0.0, 0.0, 0.0)
Draw = Callable[[imgui.ImDrawList], None]


@pytest.fixture
def canvas(offscreen: Callable[..., Window], imgui_context: None) -> Iterator[tuple[Window, ImguiRenderer]]:
    window = offscreen((200, 150))
    renderer = ImguiRenderer(window.context)
    imgui.get_io().display_size = ImVec2(200, 150)
    yield window, renderer
    renderer.release()


def paint(canvas: tuple[Window, ImguiRenderer], draw: Draw) -> np.ndarray:
    window, renderer = canvas
    imgui.new_frame()
    draw(imgui.get_foreground_draw_list())
    imgui.render()
    window.framebuffer.use()
    window.framebuffer.clear(0.0, 0.0, 0.0, 1.0)
    renderer.render(imgui.get_draw_data(), window.framebuffer)
    return window.read_pixels()


def rgba(red: int, green: int, blue: int, alpha: int = 255) -> int:
    return red | green << 8 | blue << 16 | alpha << 24


def test_a_rectangle_fills_exactly_its_pixels(canvas: tuple[Window, ImguiRenderer]) -> None:
    imgui.get_style().anti_aliased_fill = False

    def draw(lists: imgui.ImDrawList) -> None:
        lists.add_rect_filled(ImVec2(10, 20), ImVec2(30, 25), rgba(200, 100, 50))

    expected = np.zeros((150, 200, 3), np.uint8)
    expected[20:25, 10:30] = [200, 100, 50]
    np.testing.assert_array_equal(paint(canvas, draw), expected)


def test_alpha_blends_over_what_is_there(canvas: tuple[Window, ImguiRenderer]) -> None:
    def draw(lists: imgui.ImDrawList) -> None:
        lists.add_rect_filled(ImVec2(0, 0), ImVec2(200, 100), rgba(255, 255, 255))
        lists.add_rect_filled(ImVec2(0, 0), ImVec2(200, 100), rgba(255, 0, 0, 51))

    np.testing.assert_allclose(paint(canvas, draw)[50, 100], [255, 204, 204], atol=1)


def test_nothing_is_drawn_outside_a_clip_rectangle(canvas: tuple[Window, ImguiRenderer]) -> None:
    def draw(lists: imgui.ImDrawList) -> None:
        lists.push_clip_rect(ImVec2(40, 10), ImVec2(60, 30))
        lists.add_rect_filled(ImVec2(0, 0), ImVec2(200, 100), rgba(0, 255, 0))
        lists.pop_clip_rect()

    lit = paint(canvas, draw)[..., 1] > 0
    assert lit[10:30, 40:60].all()
    assert lit.sum() == 20 * 20


def test_textures_stand_upright_and_update_only_for_a_new_array(canvas: tuple[Window, ImguiRenderer]) -> None:
    cache = TextureCache(canvas[1])
    image = np.zeros((2, 2, 4), np.uint8)
    image[..., 3] = 255
    image[0, 0, 0], image[0, 1, 1], image[1, 0, 2] = 255, 255, 255  # red, green / blue, black

    def draw(lists: imgui.ImDrawList) -> None:
        lists.add_image(cache.get("picture", image, smooth=False), ImVec2(0, 0), ImVec2(20, 20))

    pixels = paint(canvas, draw)
    np.testing.assert_array_equal(pixels[5, 5], [255, 0, 0])
    np.testing.assert_array_equal(pixels[5, 15], [0, 255, 0])
    np.testing.assert_array_equal(pixels[15, 5], [0, 0, 255])
    image[0, 0] = [9, 9, 9, 255]
    np.testing.assert_array_equal(paint(canvas, draw)[5, 5], [255, 0, 0])  # the same array object is not uploaded again
    image = image.copy()
    np.testing.assert_array_equal(paint(canvas, draw)[5, 5], [9, 9, 9])
    image = np.full((3, 5, 4), 77, np.uint8)
    image[..., 3] = 255
    cache.begin_frame()
    np.testing.assert_array_equal(paint(canvas, draw)[5, 5], [77, 77, 77])
    cache.release()


def test_one_name_with_two_sizes_in_a_frame_draws_both(canvas: tuple[Window, ImguiRenderer]) -> None:
    cache = TextureCache(canvas[1])
    small, large = np.full((1, 1, 4), 255, np.uint8), np.full((4, 4, 4), 255, np.uint8)

    def draw(lists: imgui.ImDrawList) -> None:
        lists.add_image(cache.get("x", small), ImVec2(0, 0), ImVec2(10, 10))
        lists.add_image(cache.get("x", large), ImVec2(20, 0), ImVec2(30, 10))

    pixels = paint(canvas, draw)
    assert (pixels[5, 5] == 255).all()
    assert (pixels[5, 25] == 255).all()
    cache.release()


@pytest.mark.parametrize("bad", [np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2, 4)), np.zeros((0, 2, 4), np.uint8)])
def test_textures_of_another_kind_are_refused(canvas: tuple[Window, ImguiRenderer], bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"texture 'bad': got .* wants uint8 \(h, w, 4\)"):
        TextureCache(canvas[1]).get("bad", bad)


def test_text_draws_through_texture_updates(canvas: tuple[Window, ImguiRenderer]) -> None:
    def write(words: str) -> np.ndarray:
        return paint(canvas, lambda lists: lists.add_text(ImVec2(5, 5), rgba(255, 255, 255), words))

    assert write("first")[..., 0].max() == 255
    later = write("gjQ@%")  # letters that the atlas has not held before
    assert later[..., 0].max() == 255
    assert (later == 0).mean() > 0.8  # letters, not boxes


# ---- the preview -------------------------------------------------------------------------------------------------


def gradient(camera: Camera, stride: int) -> Preview:
    """Red = column, green = row of the pixel at which each texel was computed."""
    y, x = np.mgrid[: camera.height : stride, : camera.width : stride]
    image = np.stack([x, y, np.full_like(x, 7), np.full_like(x, 255)], -1).astype(np.uint8)
    return Preview(1, camera, image, np.full(x.shape, 4.0, np.float32), stride, True, 0, "fine")


def read(picture: ViewportPicture) -> np.ndarray:
    """The uppermost layer: the warped picture."""
    return pixels(picture)[..., :3]


def pixels(picture: ViewportPicture) -> np.ndarray:
    """The uppermost layer with its alpha, (H, W, 4)."""
    texture = picture.shown[-1].texture
    return np.frombuffer(texture.read(), np.uint8).reshape(texture.height, texture.width, 4).astype(int)


def on_screen(canvas: tuple[Window, ImguiRenderer], picture: ViewportPicture, camera: Camera) -> np.ndarray:
    """The picture as imgui puts it on the screen."""

    def draw(lists: imgui.ImDrawList) -> None:
        far = ImVec2(camera.width, camera.height)
        for k, (texture, first, last, alpha, _) in enumerate(picture.shown):
            tint = rgba(255, 255, 255, round(255 * alpha))
            image = canvas[1].add(texture, opaque=k == 0)
            lists.add_image(image, ImVec2(0, 0), far, ImVec2(*first), ImVec2(*last), tint)

    return paint(canvas, draw)[: camera.height, : camera.width].astype(int)


@pytest.fixture
def picture(canvas: tuple[Window, ImguiRenderer]) -> Iterator[ViewportPicture]:
    found = ViewportPicture(canvas[0].context)
    yield found
    found.release()


CAMERA = scripted.pinhole(200, 150, (4.0, 1.0, 2.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("stride", [1, 2, 4, 8, 16])
def test_every_texel_lands_on_its_pixel(
    canvas: tuple[Window, ImguiRenderer], picture: ViewportPicture, stride: int
) -> None:
    preview = gradient(CAMERA, stride)
    assert not picture.draw(preview, CAMERA, BLACK, 0.0)
    shown = on_screen(canvas, picture, CAMERA)
    assert shown.shape == (150, 200, 3)
    off = np.abs(shown[::stride, ::stride] - preview.rgba[..., :3]).max()
    assert off <= (0 if stride == 1 else 1)
    y, x = np.mgrid[:150, :200]
    inner = (x <= (preview.rgba.shape[1] - 1) * stride) & (y <= (preview.rgba.shape[0] - 1) * stride)
    np.testing.assert_allclose(shown[..., 0][inner], x[inner], atol=1)  # linear in between
    np.testing.assert_allclose(shown[..., 1][inner], y[inner], atol=1)


@pytest.mark.parametrize("stride", [1, 3, SOFT, 4 * SOFT])
def test_a_warp_to_the_same_camera_changes_nothing(
    canvas: tuple[Window, ImguiRenderer], picture: ViewportPicture, stride: int
) -> None:
    preview = scripted.render(ViewRequest(1, CAMERA, False), stride)
    picture.draw(preview, CAMERA, (1.0, 1.0, 1.0), 0.0)
    flat = on_screen(canvas, picture, CAMERA)
    tiny = CAMERA.c2w + np.array([[0, 0, 0, 1e-9], [0] * 4, [0] * 4])  # another camera, but only just
    assert picture.draw(preview, CAMERA.moved(tiny), (1.0, 1.0, 1.0), 0.0)
    warped = on_screen(canvas, picture, CAMERA)
    hit = np.isfinite(scripted.render(ViewRequest(1, CAMERA, False)).depth)
    off = np.abs(flat - warped).max(-1)
    few = 2 if stride <= SOFT else 5  # a warp of coarse pictures has fewer pixels
    assert np.quantile(off[hit], 0.97) <= few  # all but the edges, whose triangles take one side's colour
    assert off[hit].mean() < 2


def test_a_warp_moves_a_point_to_where_it_projects(picture: ViewportPicture) -> None:
    preview = scripted.render(ViewRequest(1, CAMERA, False))
    spot = np.array([0.0, 0.0, 1.0])  # the top of the ball, marked in the old image
    before, _z = CAMERA.project(spot[None])
    column, row = np.floor(before[0]).astype(int)
    marked = preview.rgba.copy()
    marked[...] = [90, 90, 90, 255]
    marked[row - 2 : row + 3, column - 2 : column + 3] = [255, 255, 255, 255]
    assert np.isfinite(preview.depth[row + 1, column])
    moved = scripted.pinhole(200, 150, (3.7, 1.4, 2.3), (0.0, 0.6, 0.2))
    assert picture.draw(replace(preview, rgba=marked), moved, BLACK, 0.0)
    lit = np.argwhere(read(picture)[..., 0] > 170)
    after = moved.project(spot[None])[0][0]
    assert np.linalg.norm(after - before[0]) > 6  # it had to move
    np.testing.assert_allclose(lit.mean(0)[::-1] + 0.5, after, atol=2.0)


def test_a_nearer_surface_hides_a_farther_one_after_the_warp(picture: ViewportPicture) -> None:
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0, np.eye(4)[:3])
    depth = np.full((100, 100), 10.0, np.float32)
    depth[:, 40:60] = 2.0
    image = np.full((100, 100, 4), 255, np.uint8)
    image[..., :3] = 50
    image[:, 40:60, :3] = 200
    preview = Preview(1, camera, image, depth, 1, True, 0, "fine")
    shifted = camera.moved(np.column_stack([np.eye(3), [-0.4, 0.0, 0.0]]))  # near moves by 20 pixels, far by 4
    picture.draw(preview, shifted, BLACK, 0.0)
    row = read(picture)[50, :, 0]
    assert (row[63:77] == 200).all()
    assert (row[10:58] == 50).all()  # uncovered pixels take the far surface's colour, not a mixture of both
    assert (row[85:100] == 50).all()


def test_what_was_not_hit_stays_background(picture: ViewportPicture) -> None:
    preview = gradient(CAMERA, 1)
    preview.depth[:] = np.nan
    assert picture.draw(preview, scripted.pinhole(200, 150, (4.0, 1.1, 2.0), (0, 0, 0)), (0.5, 0.5, 0.5), 0.0)
    assert (read(picture) == 128).all()
    assert not len(warp_mesh(preview)[1])


def test_the_warp_follows_a_new_window_size(picture: ViewportPicture) -> None:
    preview = scripted.render(ViewRequest(1, CAMERA, False))
    larger = CAMERA.resized(400, 300)
    assert picture.draw(preview, larger, (1.0, 1.0, 1.0), 0.0)
    assert read(picture).shape == (300, 400, 3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (300, 2)])
def test_tiny_previews_have_a_mesh(shape: tuple[int, int]) -> None:
    camera = Camera(shape[1], shape[0], 10.0, 10.0, shape[1] / 2, shape[0] / 2, np.eye(4)[:3])
    depth = np.full(shape, 3.0, np.float32)
    points, triangles = warp_mesh(Preview(1, camera, np.zeros((*shape, 4), np.uint8), depth, 1, True, 0, "fine"))
    assert points[:, 0].max() == shape[1]
    assert points[:, 1].max() == shape[0]
    assert len(triangles) >= 2


def coarse_floor(stride: int, noise: float = 0.0, width: int = 640) -> tuple[Preview, np.ndarray]:
    """A coarse picture of a floor that runs from 2 to 20 away, and its plane (3,): 1 / z = plane · (x, y, 1)."""
    camera = Camera(width, 640, 600.0, 600.0, width / 2, 320.0, np.eye(4)[:3])
    plane = np.array([0.0, 0.45 / 640, 0.05])
    y, x = np.mgrid[0:640:stride, 0:width:stride] + 0.5
    z = 1 / (np.stack([x, y, np.ones_like(x)], -1) @ plane)
    z *= np.exp(noise * np.random.default_rng(0).normal(size=z.shape))
    return Preview(1, camera, np.zeros((*z.shape, 4), np.uint8), z.astype(np.float32), stride, True, 0, "fine"), plane


FLOORS = pytest.mark.parametrize(("stride", "width"), [(SOFT, 640), (SOFT, 1280), (8, 640), (16, 640), (32, 640)])


@FLOORS
def test_a_coarse_picture_of_a_plane_stays_a_plane(stride: int, width: int) -> None:
    preview, plane = coarse_floor(stride, width=width)
    points, _ = warp_mesh(preview)
    border = (2 * SMOOTH + 1) * stride  # at the border there are texels on one side only
    inside = ((points[:, :2] > border) & (points[:, :2] < np.array([width, 640]) - border)).all(-1)
    expected = 1 / (np.column_stack([points[:, :2], np.ones(len(points))]) @ plane)
    assert inside.sum() > 50
    np.testing.assert_allclose(points[inside, 2], expected[inside], rtol=1e-4)


def test_a_sheet_without_edges_has_a_tenth_of_the_triangles() -> None:
    """Software GL takes its time by triangles."""
    sharp, soft = (warp_mesh(coarse_floor(stride)[0])[1] for stride in (2, SOFT))
    assert len(sharp) == 2 * MESH_CELLS**2
    assert len(soft) <= 2 * SHEET_CELLS**2
    assert 10 * len(soft) <= len(sharp)


def test_what_was_not_hit_is_drawn_beside_hits_alone() -> None:
    preview, _ = coarse_floor(2)
    preview.depth[:] = np.nan
    preview.depth[100:141, 20:31] = 3.0
    points, triangles = sheet(preview, 3.0)
    assert len(triangles) == 2
    assert sorted(set(points[:, 0])) == [0, 2 * 30 + BESIDE]  # it ends with the picture
    assert sorted(set(points[:, 1])) == [2 * 100 - BESIDE, 2 * 140 + BESIDE]


@FLOORS
def test_a_sheet_is_there_if_only_a_texel_between_its_points_was_hit(stride: int, width: int) -> None:
    preview, _ = coarse_floor(stride, width=width)
    whole = warp_mesh(preview)[1]
    for k in range(len(preview.depth)):
        preview.depth[:] = np.nan
        preview.depth[k, k] = 3.0
        points, triangles = warp_mesh(preview)
        assert len(triangles) == len(whole)
        np.testing.assert_allclose(points[:, 2], 3.0, rtol=1e-6)


@pytest.mark.parametrize("stride", [1, SOFT])
def test_a_depth_that_is_infinite_counts_as_not_hit(stride: int) -> None:
    preview, _ = coarse_floor(stride)
    preview.depth[::3, ::5] = np.inf
    points, triangles = warp_mesh(preview)
    assert len(triangles)
    assert np.isfinite(points[triangles]).all()


@FLOORS
def test_a_coarse_noisy_picture_does_not_fold(stride: int, width: int) -> None:
    """No triangle of it turns over when the camera moves aside."""
    preview, _ = coarse_floor(stride, 0.05, width)
    points, triangles = warp_mesh(preview)
    aside = 24 * stride / 600 * points[:, 2].min()  # moves the nearest point by 24 texels
    seen = points[:, :2] - np.column_stack([600 * aside / points[:, 2], np.zeros(len(points))])

    def area(corners: np.ndarray) -> np.ndarray:
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]

    turned = np.sign(area(seen[triangles])) != np.sign(area(points[triangles, :2]))
    assert not turned.any()


def test_a_sharp_picture_is_trusted_where_it_shows_more_than_the_newest_one(picture: ViewportPicture) -> None:
    """What it did not see, outside its frame and behind the nearer surface, is left to the newest one."""
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0, np.eye(4)[:3])
    depth = np.full((100, 100), 10.0, np.float32)
    depth[:, 40:60] = 2.0
    preview = Preview(1, camera, np.full((100, 100, 4), 255, np.uint8), depth, 1, True, 0, "fine")
    shifted = camera.moved(np.column_stack([np.eye(3), [-0.4, 0.0, 0.0]]))  # near moves by 20 pixels, far by 4
    picture.draw(preview, camera, BLACK, 0.0)
    part = np.s_[::16, ::16]
    coarse = replace(preview, camera=shifted, rgba=preview.rgba[part], depth=depth[part], stride=16)
    assert picture.draw(coarse, shifted, BLACK, 1.0)
    row = pixels(picture)[50, :, 3]
    assert (row[:4] == 0).all()
    assert (row[6:40] == 255).all()
    assert (row[46:58] == 0).all()  # uncovered, and 16 pixels wide
    assert (row[64:78] == 255).all()
    assert (row[82:] == 255).all()
    sharp = replace(coarse, stride=1, rgba=preview.rgba, depth=depth)
    assert picture.draw(sharp, shifted, BLACK, 2.0)  # it fades in
    assert not picture.draw(sharp, shifted, BLACK, 3.0)


def test_a_sharp_outline_stays_sharp_over_a_coarse_picture(picture: ViewportPicture) -> None:
    """Beside what it hit, the sharp picture covers what the coarse one smears there; far from it nothing is smeared."""
    camera = Camera(400, 100, 100.0, 100.0, 200.0, 50.0, np.eye(4)[:3])
    depth = np.full((100, 400), np.nan, np.float32)
    depth[40:60, 180:220] = 2.0
    preview = Preview(1, camera, np.full((100, 400, 4), 255, np.uint8), depth, 1, True, 0, "fine")
    shifted = camera.moved(np.column_stack([np.eye(3), [-0.1, 0.0, 0.0]]))  # by 5 pixels
    picture.draw(preview, camera, BLACK, 0.0)
    part = np.s_[::16, ::16]
    picture.draw(
        replace(preview, camera=shifted, rgba=preview.rgba[part], depth=depth[part], stride=16), shifted, BLACK, 1.0
    )
    row = pixels(picture)[50, :, 3]
    assert (row[185 - BESIDE + 1 : 224 + BESIDE - 1] == 255).all()
    assert (row[: 185 - BESIDE - 1] == 0).all()
    assert (row[224 + BESIDE + 1 :] == 0).all()


def test_the_border_of_a_picture_that_is_kept_does_not_show(
    canvas: tuple[Window, ImguiRenderer], picture: ViewportPicture
) -> None:
    for stride, camera in ((8, CAMERA), (64, scripted.pinhole(200, 150, (4.0, 1.3, 2.0), (0.5, 0.5, 0.5)))):
        shape = -(-150 // stride), -(-200 // stride)
        white = np.full((*shape, 4), 255, np.uint8)
        preview = Preview(1, camera, white, np.full(shape, 4.0, np.float32), stride, True, 0, "fine")
        picture.draw(preview, camera, (1.0, 1.0, 1.0), 0.0)
    assert len(picture.shown) == 2
    part = pixels(picture)[..., 3] > 0
    assert 0.2 < part.mean() < 0.98
    assert (on_screen(canvas, picture, CAMERA) == 255).all()


def test_the_estimated_blur_grows_with_angle_zoom_and_training(canvas: tuple[Window, ImguiRenderer]) -> None:
    preview = replace(scripted.render(ViewRequest(1, CAMERA, False), 2), step=900, born=100)
    layer = Layer(canvas[0].context, preview, 0.0)
    assert layer.blur(CAMERA, 900) == pytest.approx([2.0])
    assert layer.blur(CAMERA, 1167) == pytest.approx([4.0], rel=0.01)  # 4/3 of its steps
    nearer = scripted.pinhole(200, 150, (2.0, 0.5, 1.0), (0.0, 0.0, 0.0))
    assert 3.5 < np.median(layer.blur(nearer, 900)) < 12.0
    turned = [scripted.pinhole(200, 150, (4 * np.cos(a), 4 * np.sin(a), 2.0), (0, 0, 0)) for a in (0.25, 0.5, 1.0)]
    blurs = [float(np.median(layer.blur(camera, 900))) for camera in turned]
    assert blurs == sorted(blurs)
    away = scripted.pinhole(200, 150, (4.0, 1.0, 2.0), (8.0, 2.0, 4.0))
    assert not len(layer.blur(away, 900))
    layer.release()


# ---- lines in space ------------------------------------------------------------------------------------------------


def test_a_line_through_the_eye_is_cut_at_the_near_plane() -> None:
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0, np.eye(4)[:3])
    start, end = np.array([[0.1, 0.0, 5.0]]), np.array([[0.1, 0.0, -5.0]])  # from behind the eye to before it
    a, b, visible = clip_segments(camera, start, end, near=0.5)
    assert visible[0]
    np.testing.assert_allclose(a[0], [50 + 100 * 0.1 / 0.5, 50])
    np.testing.assert_allclose(b[0], [50 + 100 * 0.1 / 5, 50])


def test_clipped_lines_stay_in_the_picture_and_on_themselves() -> None:
    rng = np.random.default_rng(0)
    starts, ends = rng.normal(size=(2, 500, 3)) * 4
    camera = scripted.pinhole(200, 150, (1.0, 0.5, 0.3), (0, 0, 0))
    a, b, visible = clip_segments(camera, starts, ends, near=0.01)
    assert 50 < visible.sum() < 500
    for p in (a[visible], b[visible]):
        assert (p >= -1e-6).all()
        assert (p <= [200 + 1e-6, 150 + 1e-6]).all()
    for k in np.flatnonzero(visible):  # every visible point of the line lies on its drawn part
        points = starts[k] + np.linspace(0, 1, 50)[:, None] * (ends[k] - starts[k])
        pixels, z = camera.project(points)
        inside = (z > 0.011) & (pixels > 0).all(-1) & (pixels < [200, 150]).all(-1)
        way = b[k] - a[k]
        length = np.linalg.norm(way)
        if length < 1e-3:
            continue
        across = np.abs((pixels - a[k]) @ np.array([-way[1], way[0]]) / length)
        along = (pixels - a[k]) @ way / length
        assert (across[inside] < 1e-3).all()
        assert ((along[inside] > -1e-3) & (along[inside] < length + 1e-3)).all()


def test_lines_behind_the_eye_are_not_drawn() -> None:
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0, np.eye(4)[:3])
    assert not clip_segments(camera, np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 2]]), 0.1)[2][0]


def test_a_frustum_spans_what_its_camera_sees() -> None:
    starts, ends = frusta([CAMERA], 0.5)
    assert starts.shape == ends.shape == (8, 3)
    np.testing.assert_allclose(starts[:4], np.broadcast_to(CAMERA.c2w[:, 3], (4, 3)))
    pixels, z = CAMERA.project(ends[:4])
    np.testing.assert_allclose(z, 0.5)
    np.testing.assert_allclose(pixels, [[0, 0], [200, 0], [200, 150], [0, 150]], atol=1e-9)


def test_the_axes_turn_with_the_camera() -> None:
    looking_along_minus_z = Camera(10, 10, 10.0, 10.0, 5.0, 5.0, np.eye(4)[:3])
    (x, _, _), (y, _, y_up), (_, towards, _) = axis_directions(looking_along_minus_z, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(x, [1, 0])
    np.testing.assert_allclose(y, [0, -1])  # up on a screen whose rows grow downwards
    assert y_up
    assert towards == 1


def test_the_sample_under_the_mouse_is_the_one_that_is_drawn_there(canvas: tuple[Window, ImguiRenderer]) -> None:
    """Seen from the side, each sample with some weight is found at its place. Seen along the ray, none is."""
    ray, camera, corner, em = make_ray(), make_camera(np.array([0.5, 3.2, 1.0])), np.array([30.0, 20.0]), 3.0
    last = ray.passes[-1]
    places = camera.project(ray.origin + last.t[:, None] * ray.direction)[0] + corner
    heavy = np.flatnonzero(last.weights > 0.02)
    first, final = places[heavy[0]], places[heavy[-1]]
    assert np.linalg.norm(first - final) > em

    def draw(lists: imgui.ImDrawList) -> None:
        overlay = Overlay(lists, camera, (30.0, 20.0), 1e-3)
        overlay.samples([ray], em)
        for place in places[heavy]:
            found = overlay.sample_at(ray, em, *place)
            assert found is not None
            assert np.linalg.norm(places[found] - place) < 1e-6
        assert overlay.sample_at(ray, em, *first) != overlay.sample_at(ray, em, *final)
        assert overlay.sample_at(ray, em, first[0], first[1] + 40) is None
        eye = make_camera(ray.origin)
        x, y = eye.project(ray.origin[None] + 3.8 * ray.direction[None])[0][0]
        assert Overlay(lists, eye, (0.0, 0.0), 1e-3).sample_at(ray, em, x, y) is None

    shown = paint(canvas, draw)
    x, y = np.floor(places[heavy[-1]]).astype(int)
    np.testing.assert_allclose(shown[y, x] / 255, last.rgb[heavy[-1]], atol=0.15)  # neighbours differ little in colour


def test_the_visits_of_a_ray_without_samples_are_drawn_at_their_places(canvas: tuple[Window, ImguiRenderer]) -> None:
    ray, camera, corner, em = bare_ray(), make_camera(np.array([0.5, 3.2, 1.0])), np.array([30.0, 20.0]), 8.0
    places = camera.project(ray.origin + ray.visited[:, None] * ray.direction)[0] + corner
    red, green = ImVec4(1, 0, 0, 1), ImVec4(0, 1, 0, 1)

    def draw(lists: imgui.ImDrawList) -> None:
        overlay = Overlay(lists, camera, (30.0, 20.0), 1e-3)
        overlay.visits(ray, em, Ink(red, green, green), numbered=False)
        assert overlay.visit_at(ray, em, *places[0]) == 0
        assert overlay.visit_at(ray, em, *places[1]) == 1
        assert overlay.visit_at(ray, em, places[0][0], places[0][1] + 40) is None
        eye = make_camera(ray.origin)
        x, y = eye.project(ray.origin[None] + 3.8 * ray.direction[None])[0][0]
        along = Overlay(lists, eye, (0.0, 0.0), 1e-3)
        assert along.visit_at(ray, em, x, y) is None  # all lie behind each other
        Overlay(lists, camera, (0.0, 0.0), 1e-3).visits(bare_ray(0, None), em, Ink(red, green, green))

    shown = paint(canvas, draw)
    for x, y in np.floor(places[[0, 1, 2, -1]]).astype(int):
        np.testing.assert_array_equal(shown[y, x], [255, 0, 0])


def test_of_visits_behind_each_other_only_the_last_is_drawn(
    canvas: tuple[Window, ImguiRenderer], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[list[int]] = []
    monkeypatch.setattr(
        "viewer.draw.overlays.discs", lambda _, at, *__: drawn.append([k for k, p in enumerate(at) if p is not None])
    )
    ray, red = bare_ray(), ImVec4(1, 0, 0, 1)

    def draw(lists: imgui.ImDrawList) -> None:
        for eye in (ray.origin, np.array([0.5, 3.2, 1.0])):
            Overlay(lists, make_camera(eye), (0.0, 0.0), 1e-3).visits(ray, 1.0, Ink(red, red, red))

    paint(canvas, draw)
    assert drawn[0] == [9]
    assert {0, 1, 2, 3, 9} <= set(drawn[1])


def test_rims_lie_around_the_samples_and_over_none_of_them(canvas: tuple[Window, ImguiRenderer]) -> None:
    ray, camera, em, red = make_ray(), make_camera(np.array([0.5, 3.2, 1.0])), 6.0, ImVec4(1, 0, 0, 1)
    places = camera.project(ray.origin + ray.passes[-1].t[:, None] * ray.direction)[0]
    heavy = places[ray.passes[-1].weights > 0.02]
    assert np.linalg.norm(np.diff(heavy, axis=0), axis=1).max() < 0.3 * em  # they overlap

    def shown(*rims: tuple[ImVec4, float]) -> np.ndarray:
        return paint(canvas, lambda lists: Overlay(lists, camera, (0.0, 0.0), 1e-3).samples([ray], em, *rims))

    bare, rimmed = shown(), shown((red, 3.0))
    for x, y in np.floor(heavy).astype(int):
        np.testing.assert_array_equal(rimmed[y, x], bare[y, x])
    new = (bare == 0).all(-1) & (rimmed == [255, 0, 0]).all(-1)
    assert new.sum() > 50


def test_discs_that_later_ones_cover_are_not_drawn() -> None:
    """Each disc that is left out lies within one that is drawn after it."""
    rng = np.random.default_rng(0)
    for spread in (0.0, 2.0, 30.0):
        places, radii = spread * rng.normal(size=(120, 2)), rng.uniform(2.0, 7.0, 120)
        kept = uncovered(places, radii)
        for k in np.flatnonzero(~kept):
            later = [j for j in np.flatnonzero(kept) if j > k]
            assert any(np.linalg.norm(places[j] - places[k]) + radii[k] <= radii[j] + 0.12 for j in later)
        for k in np.flatnonzero(kept):
            reach = radii - np.linalg.norm(places - places[k], axis=-1)
            assert (reach[k + 1 :] < radii[k]).all()
    assert uncovered(np.zeros((50, 2)), np.full(50, 3.0)).tolist() == [False] * 49 + [True]
    assert uncovered(np.zeros((3, 2)), np.array([3.0, 5.0, 4.0])).tolist() == [False, True, True]
    assert uncovered(np.zeros((0, 2)), np.zeros(0)).tolist() == []


def test_several_rays_are_drawn_over_each_other_each_with_its_rims(canvas: tuple[Window, ImguiRenderer]) -> None:
    first, em = make_ray(), 6.0
    second = replace(first, origin=first.origin + np.array([0.0, 0.0, 0.1]), passes=first.passes[:1])
    hidden = replace(first, origin=first.origin + np.array([0.0, 50.0, 0.0]))  # behind the camera
    camera = make_camera(np.array([0.5, 3.2, 1.0]))
    tones = ImVec4(1, 0, 0, 1), ImVec4(0, 1, 0, 1), ImVec4(0, 0, 1, 1)

    def all_at_once(lists: imgui.ImDrawList) -> None:
        overlay = Overlay(lists, camera, (0.0, 0.0), 1e-3)
        overlay.samples([first, hidden, second], em, (tones[0], 4.0), ([tones[1], tones[0], tones[2]], 2.0))
        overlay.samples([], em, (tones[0], 3.0))

    def one_by_one(lists: imgui.ImDrawList) -> None:
        overlay = Overlay(lists, camera, (0.0, 0.0), 1e-3)
        for ray, tone in zip((first, hidden, second), (tones[1], tones[0], tones[2]), strict=True):
            overlay.samples([ray], em, (tones[0], 4.0), (tone, 2.0))

    shown = paint(canvas, all_at_once)
    np.testing.assert_array_equal(shown, paint(canvas, one_by_one))
    for tone in tones:
        assert (shown == [255 * tone.x, 255 * tone.y, 255 * tone.z]).all(-1).any()


@pytest.mark.parametrize("eye", [(0.5, 3.2, 1.0), (3.2, 0.0, 2.4), (0.4, -1.5, 0.3)])
def test_a_tag_lies_wholly_in_the_picture(canvas: tuple[Window, ImguiRenderer], eye: tuple[float, ...]) -> None:
    """Also if the camera looks along the ray, and if the ray leaves the picture."""
    ray, camera, blue = make_ray(), make_camera(np.array(eye)), ImVec4(0, 0, 1, 1)
    start, end = (ray.origin + t * ray.direction for t in (ray.near, ray.far))

    def draw(lists: imgui.ImDrawList) -> None:
        Overlay(lists, camera, (0.0, 0.0), 1e-3).tags(start[None], end[None], ["ray 4"], 13.0, [blue], blue)

    lit = np.argwhere((paint(canvas, draw) == [0, 0, 255]).all(-1))
    high, wide = lit.max(0) - lit.min(0)
    assert high > 8
    assert wide > 25
    _, ((x, y),), _ = clip_segments(camera, start[None], end[None], 1e-3)
    assert np.abs(lit - (y, x)).max(1).min() < 2 * 13.0


def test_tags_of_rays_that_end_at_one_place_lie_apart(canvas: tuple[Window, ImguiRenderer]) -> None:
    camera = make_camera(np.array([3.2, 0, 2.4]))
    ends = np.tile(camera.c2w[:, 3] - 6 * camera.c2w[:, 2], (3, 1))
    starts = ends + 4 * camera.c2w[:, 2]
    colors = [ImVec4(0, 0, 1, 1), ImVec4(0, 1, 0, 1), ImVec4(1, 0, 0, 1)]

    def draw(lists: imgui.ImDrawList, count: int = 3) -> None:
        first = starts[:count], ends[:count], ["ray 1", "ray 2", "ray 3"][:count]
        Overlay(lists, camera, (0.0, 0.0), 1e-3).tags(*first, 13.0, colors[:count], ImVec4(0, 0, 0, 1))

    def area(picture: np.ndarray, k: int) -> int:
        return int((picture == [[0, 0, 255], [0, 255, 0], [255, 0, 0]][k]).all(-1).sum())

    alone, together = paint(canvas, lambda lists: draw(lists, 1)), paint(canvas, draw)
    assert area(together, 0) == area(alone, 0) > 200
    assert area(together, 1) == pytest.approx(area(alone, 0), rel=0.2)  # except for what the letters cover
    assert area(together, 2) == pytest.approx(area(alone, 0), rel=0.2)


@pytest.mark.parametrize("y", [0.0, 37.0, 185.0])
def test_boxes_are_moved_apart_by_as_little_as_possible(y: float) -> None:
    taken: list[Box] = []
    for _ in range(8):
        taken.append(clear_of(taken, Box(10, y, 40, 15), 200))
    tops = sorted(box.y for box in taken)
    assert min(np.diff(tops)) >= 15
    assert tops[0] >= 0
    assert tops[-1] <= 185
    assert tops[-1] - tops[0] == 7 * 16  # side by side
    assert taken[0].y == y
    beside = Box(60, y, 40, 15)
    assert clear_of(taken, beside, 200) == beside
    assert clear_of(taken, Box(10, y, 40, 150), 200) == Box(10, y, 40, 150)  # no free place is that high


def test_the_tag_of_a_ray_seen_from_its_camera_lies_to_the_right(canvas: tuple[Window, ImguiRenderer]) -> None:
    camera, blue = make_camera(np.array([3.2, 0, 2.4])), ImVec4(0, 0, 1, 1)
    start, end = (camera.c2w[:, 3] - t * camera.c2w[:, 2] for t in (2.0, 6.0))
    side = 1e-9 * camera.c2w[:, 0]
    for shift in (-side, side):

        def draw(lists: imgui.ImDrawList, last: np.ndarray = end + shift) -> None:
            Overlay(lists, camera, (0.0, 0.0), 1e-3).tags(start[None], last[None], ["a"], 13.0, [blue], blue)

        lit = np.argwhere((paint(canvas, draw) == [0, 0, 255]).all(-1))
        assert lit[:, 1].min() > camera.cx + 13.0


def test_a_tag_of_what_is_out_of_sight_is_not_drawn(canvas: tuple[Window, ImguiRenderer]) -> None:
    camera, blue = make_camera(np.array([3.2, 0, 2.4])), ImVec4(0, 0, 1, 1)
    behind = camera.c2w[:, 3] + camera.c2w[:, 2]

    def draw(lists: imgui.ImDrawList) -> None:
        Overlay(lists, camera, (0.0, 0.0), 1e-3).tags(behind[None], 2 * behind[None], ["a"], 13.0, [blue], blue)

    assert not paint(canvas, draw).any()
