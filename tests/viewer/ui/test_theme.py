"""The theme's colours."""

from __future__ import annotations

import pytest
from imgui_bundle import ImVec4

from viewer.ui.theme import DarkTheme

LEAST_CONTRAST = 4.5  # of text, https://www.w3.org/TR/WCAG22/#contrast-minimum


@pytest.mark.parametrize("pin", range(len(DarkTheme.pins)))
def test_a_pins_colour_is_legible_as_text_and_under_text(pin: int) -> None:
    color = DarkTheme.pins[pin]
    assert round(contrast(color, DarkTheme.surface), 2) >= LEAST_CONTRAST  # its name in a panel
    assert round(contrast(color, DarkTheme.ground), 2) >= LEAST_CONTRAST  # its label in the viewport


def contrast(one: ImVec4, other: ImVec4) -> float:
    """The contrast ratio of two sRGB colours, 1 … 21, as WCAG defines it."""
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def luminance(color: ImVec4) -> float:
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in (color.x, color.y, color.z)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
