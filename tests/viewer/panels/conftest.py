"""The screen that panels are drawn on."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from imgui_bundle import ImVec2, imgui, implot
from panel_screen import SCREEN, Screen


@pytest.fixture
def screen(imgui_context: None) -> Iterator[Screen]:
    implot.create_context()
    io = imgui.get_io()
    io.display_size = ImVec2(*SCREEN)
    io.delta_time = 0.2  # so slow that two clicks are no double click
    io.backend_flags |= imgui.BackendFlags_.renderer_has_textures
    yield Screen()
    implot.destroy_context()
