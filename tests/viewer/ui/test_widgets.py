"""What panels share."""

from __future__ import annotations

import numpy as np
import pytest

from viewer.ui.widgets import color_of


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_colour_of_the_model_is_clipped_and_nan_is_zero(kind: type) -> None:
    found = color_of(np.array([np.nan, -0.5, 0.25], kind), 0.5)
    assert (found.x, found.y, found.z, found.w) == (0, 0, 0.25, 0.5)
    found = color_of(np.array([1.5, np.inf, -np.inf], kind))
    assert (found.x, found.y, found.z, found.w) == (1, 1, 0, 1)
