"""Stacks of pictures: where the cards lie."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from viewer.draw.picture_stack import cards


@given(
    st.lists(st.tuples(st.integers(1, 200), st.integers(1, 200)), min_size=1, max_size=40),
    st.tuples(st.floats(20, 900), st.floats(20, 900)),
)
def test_cards_lie_in_the_space_in_their_order_and_shapes(
    sizes: list[tuple[int, int]], room: tuple[float, float]
) -> None:
    boxes = cards(sizes, room)
    assert (boxes >= -1e-9).all()
    assert (boxes[:, 2:] <= np.array(room) + 1e-6).all()
    assert (np.diff(boxes[:, 0]) >= -1e-9).all()  # the later ones lie farther right,
    assert (np.diff(boxes[:, 3]) <= 1e-9).all()  # and farther up
    shapes = (boxes[:, 2:] - boxes[:, :2]) / np.array(sizes)
    np.testing.assert_allclose(shapes, shapes[0, 0])  # one scale for all


def test_one_picture_fills_the_space() -> None:
    np.testing.assert_allclose(cards([(40, 30)], (200, 90)), [[0, 0, 120, 90]])


@pytest.mark.parametrize("count", [2, 5, 32])
def test_a_part_of_every_card_is_seen(count: int) -> None:
    boxes = cards([(40, 30)] * count, (260, 150))
    assert (np.diff(boxes[:, 2]) > 1).all()  # more than a pixel, where the mouse can reach it
    assert boxes[0, 2] - boxes[0, 0] > 0.5 * 150 * 40 / 30
