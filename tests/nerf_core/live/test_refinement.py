"""Refinement computes every pixel once, puts it in its place, and keeps up with training."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerf_core.geometry.camera import Camera
from nerf_core.live.refinement import COARSEST, FRESH_SECONDS, Refinement, first_stride
from nerf_core.rendering.images import to_bytes

sizes = st.integers(1, 90)


def camera(width: int, height: int) -> Camera:
    return Camera(width, height, 50.0, 50.0, width / 2, height / 2, np.eye(4)[:3])


def code(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A colour and a depth that encode their pixel (column, row)."""
    color = np.stack([pixels[:, 0], pixels[:, 1], np.zeros(len(pixels))], -1) / 255
    return color.astype(np.float32), (pixels[:, 0] * 1000 + pixels[:, 1]).astype(np.float32)


def work(picture: Refinement, step: int, count: int) -> np.ndarray:
    """Draw one piece. Returns the pixels that were computed."""
    cells = picture.take(count)
    pixels = picture.pixels(cells)
    picture.write(cells, *code(pixels), step)
    return pixels


@given(sizes, sizes, st.sampled_from([1, 2, 8, 64]), st.integers(1, 200))
def test_every_pixel_is_computed_exactly_once(width: int, height: int, stride: int, tile: int) -> None:
    picture = Refinement(camera(width, height), 1, stride, "fine")
    times = np.zeros((height, width), int)
    strides = []
    while picture.advance(step=7):
        pixels = work(picture, 7, tile)
        assert len(pixels) > 0
        times[pixels[:, 1], pixels[:, 0]] += 1
        strides.append(picture.stride)
        assert times[:: picture.stride, :: picture.stride].sum() == times.sum()
    assert (times == 1).all()
    assert strides == sorted(strides, reverse=True)
    shown = picture.image()
    assert (shown.complete, shown.stride, shown.rgba.shape) == (True, 1, (height, width, 4))


@given(sizes, sizes, st.sampled_from([4, 32]))
def test_texels_lie_at_their_pixels_at_all_times(width: int, height: int, stride: int) -> None:
    picture = Refinement(camera(width, height), 3, stride, "coarse")
    done = np.zeros((height, width), bool)
    rows, columns = np.mgrid[:height, :width]
    color, depth = code(np.stack([columns.ravel(), rows.ravel()], -1))
    truth = to_bytes(color.reshape(height, width, 3))
    while picture.advance(step=1):
        pixels = work(picture, 1, 50)
        done[pixels[:, 1], pixels[:, 0]] = True
        shown, s = picture.image(), picture.stride
        computed = done[::s, ::s]
        assert shown.rgba.shape == (*computed.shape, 4)
        assert (shown.rgba[computed, :3] == truth[::s, ::s][computed]).all()
        assert (shown.depth[computed] == depth.reshape(height, width)[::s, ::s][computed]).all()
        assert (shown.rgba[..., 3] == 255).all()


def test_missing_texels_are_interpolated_from_the_coarser_level() -> None:
    picture = Refinement(camera(5, 1), 1, 2, "fine")
    assert picture.advance(0)
    work(picture, 0, 10)
    assert picture.advance(0)
    red = picture.image().rgba[0, :, 0]
    assert red.tolist() == [0, 1, 2, 3, 4]


def test_first_level_done_is_set_when_all_its_pixels_are_drawn() -> None:
    picture = Refinement(camera(8, 8), 1, 4, "fine")
    picture.advance(0)
    work(picture, 0, 3)
    assert not picture.first_level_done
    work(picture, 0, 3)
    assert picture.first_level_done


def test_pixels_come_from_the_centre_outwards() -> None:
    picture = Refinement(camera(21, 21), 1, 1, "fine")
    picture.advance(0)
    distance = np.linalg.norm(picture.pixels(picture.take(441)) - 10, axis=-1)
    assert (np.diff(distance) >= 0).all()


def finished(picture: Refinement, step: int) -> list[tuple[int, int]]:
    """Draw until nothing is left to do at this step. Returns the pixels that were drawn."""
    drawn = []
    while picture.advance(step):
        drawn += [tuple(p) for p in work(picture, step, 10)]
    return drawn


def test_a_whole_picture_is_refreshed_in_place_as_training_goes_on() -> None:
    picture = Refinement(camera(6, 5), 1, 4, "fine")
    assert len(finished(picture, 100)) == 30
    assert finished(picture, 100) == []
    assert len(finished(picture, 101)) == 30
    assert picture.stride == 1
    assert picture.image().complete
    assert picture.image().step == 101


def test_a_level_is_refined_only_if_the_finer_one_can_be_drawn_in_time() -> None:
    """The level takes 10 steps, the finer one 40. From step 120 on these are in time: 120 ≥ YOUNG · (120 + 40)."""
    for begin, stride in ((109, 4), (110, 2)):
        picture = Refinement(camera(8, 8), 1, 4, "fine")
        picture.advance(begin)
        work(picture, begin, 4)
        assert picture.advance(begin + 10)
        assert picture.stride == stride
        assert len(picture.take(100)) == {4: 4, 2: 16}[stride]


def test_while_training_the_first_level_is_drawn_again_to_see_how_fast_the_weights_change() -> None:
    """It is drawn again only once: where a step takes minutes, the same picture again shows nothing new."""
    picture = Refinement(camera(8, 8), 1, 4, "fine")
    for _ in range(2):
        assert picture.advance(5, training=True)
        assert picture.stride == 4
        work(picture, 5, 4)
    assert picture.advance(5, training=True)
    assert picture.stride == 2


def test_a_picture_is_shown_while_its_pixels_are_of_one_step() -> None:
    picture = Refinement(camera(8, 8), 1, 4, "fine")
    picture.advance(10)
    work(picture, 10, 4)
    assert picture.coherent()
    picture.advance(20)
    work(picture, 20, 2)
    assert not picture.coherent()
    work(picture, 20, 2)
    assert picture.coherent()
    picture.advance(20)  # the weights did not change: a finer level is shown while it is drawn
    work(picture, 20, 2)
    assert picture.stride == 2
    assert picture.coherent()


def test_a_finer_level_is_all_of_one_age() -> None:
    """Every second texel older than its neighbours would show as a grid of dots."""
    picture = Refinement(camera(8, 8), 1, 2, "fine")
    picture.advance(100)
    work(picture, 100, 16)
    assert picture.advance(101)
    assert len(picture.take(100)) == 64
    picture = Refinement(camera(8, 8), 1, 2, "fine")
    picture.advance(100)
    work(picture, 100, 16)
    assert picture.advance(100)
    assert len(picture.take(100)) == 48


def whole(born: int = 0) -> Refinement:
    """A full picture, drawn at step born + 300 while training was paused; its first level had a stride of 8."""
    picture = Refinement(camera(64, 64), 1, 8, "fine", born=born)
    finished(picture, born + 300)
    assert picture.complete()
    return picture


@pytest.mark.parametrize("born", [0, 5000])
def test_a_level_that_would_be_outdated_is_dropped_for_one_that_is_done_in_time(born: int) -> None:
    """A level of step 301 is up to date until step 401. It is abandoned after twice as many steps, at 502."""
    picture = whole(born)
    begun = born + 301
    assert picture.advance(begun, training=True)
    for step in (begun, begun + 200):
        assert picture.advance(step, training=True)
        assert picture.stride == 1
        work(picture, begun, 1024)
    now = begun + 201
    assert picture.advance(now, training=True)  # half is done: the whole takes 402 steps, a quarter of it 100
    assert picture.stride == 2
    for step in (now, now + 50):
        assert picture.advance(step, training=True)
        work(picture, now, 512)
    assert picture.coherent()
    assert (picture.image().stride, picture.image().step) == (2, now)


def test_no_level_takes_long_while_training_goes_on() -> None:
    """The limit in seconds holds even if steps are few and slow."""
    picture = whole()
    assert picture.advance(301, training=True, now=100.0)
    work(picture, 301, 1024)
    assert picture.advance(301, training=True, now=100 + 2 * FRESH_SECONDS)
    assert picture.stride == 1
    # a quarter is done: the whole would take 8 limits
    assert picture.advance(301, training=True, now=101 + 2 * FRESH_SECONDS)
    assert picture.stride == 4
    for k in range(3):  # drawn in time, but the next level would not be
        work(picture, 302 + k, 256)
        assert picture.advance(303 + k, training=True, now=101 + (2.8 + 0.8 * k) * FRESH_SECONDS)
        assert picture.stride == 4
    finished(picture, 305)  # training is paused
    assert picture.complete()


def test_a_picture_never_gets_coarser_than_its_first_level() -> None:
    picture = whole()
    picture.advance(301, training=True)
    work(picture, 301, 1)
    assert picture.advance(20_000, training=True, now=1e6)
    assert picture.stride == 8
    work(picture, 20_000, 10)
    assert picture.advance(90_000, training=True, now=2e6)
    assert len(picture.take(100)) == 54  # the first level is not abandoned


@pytest.mark.parametrize("affordable", [0.5, 1, 100, 5000, 1e9])
def test_first_stride_is_the_smallest_that_can_be_afforded(affordable: float) -> None:
    def texels(stride: int) -> int:
        return -(-300 // stride) * -(-200 // stride)

    stride = first_stride(300, 200, affordable)
    assert stride in {2**k for k in range(7)}
    assert texels(stride) <= affordable or stride == COARSEST
    assert stride == 1 or texels(stride // 2) > affordable
