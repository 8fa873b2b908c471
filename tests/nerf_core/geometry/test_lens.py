"""The lens by round trips, and where it has no inverse."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nerf_core.geometry.lens import PINHOLE, Lens

mild = st.builds(  # lenses that fold nowhere on the grid below
    Lens,
    st.floats(-0.15, 0.15),
    st.floats(-0.05, 0.05),
    st.floats(-0.02, 0.02),
    st.floats(-0.01, 0.01),
    st.floats(-0.01, 0.01),
)
GRID = np.stack(np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.5, 0.5, 9)), -1).reshape(-1, 2)


@given(mild)
def test_undistort_inverts_distort(lens: Lens) -> None:
    bent = lens.distort(GRID)
    np.testing.assert_allclose(lens.undistort(bent), GRID, atol=1e-9)
    assert lens.shows(GRID, bent).all()


@given(mild, mild)
def test_points_may_have_a_lens_each(one: Lens, other: Lens) -> None:
    first = np.arange(len(GRID)) < 40
    both = Lens(*(np.where(first, a, b) for a, b in zip(one.coefficients, other.coefficients, strict=True)))
    bent = both.distort(GRID)
    np.testing.assert_array_equal(bent, np.where(first[:, None], one.distort(GRID), other.distort(GRID)))
    np.testing.assert_array_equal(
        both.undistort(bent), np.where(first[:, None], one.undistort(bent), other.undistort(bent))
    )


def test_only_a_pinhole_does_not_bend() -> None:
    assert not PINHOLE.bends
    assert not Lens(k1=np.zeros(3)).bends
    assert Lens(p2=1e-9).bends
    assert Lens(k3=np.array([0, 0, 0.1])).bends


def test_a_folded_point_is_not_shown() -> None:
    lens = Lens(k1=-0.3)  # turns back at r = 1.05
    points = np.array([[0.5, 0.0], [1.6, 0.0]])
    assert lens.shows(points, lens.distort(points)).tolist() == [True, False]


def test_where_newton_fails_the_point_stays() -> None:
    bent = np.array([[1 / 3, 1 / 3], [5e8, 5e8]])
    found = Lens(k1=-1e3, k2=1e6, k3=-1e6).undistort(bent)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(Lens(k1=-1.0).undistort(np.array([[1 / 3**0.5, 0.0]])), [[1 / 3**0.5, 0.0]])
