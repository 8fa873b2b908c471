"""The contract that both kinds of window fulfil."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from desk import PATIENCE

from viewer.window import DisplayError, Window, open_window


def settle(window: Window) -> None:
    """Process events: a real window learns its size from the system some events later."""
    for _ in range(20):
        window.poll(0.01)


def test_its_context_is_a_core_profile_of_at_least_3_3(window: Window) -> None:
    assert window.context.version_code >= 330


def test_pixels_come_back_as_they_were_drawn_top_row_first(window: Window) -> None:
    settle(window)
    width, height = window.size()
    assert (width, height) == (640, 480)
    window.framebuffer.use()
    window.framebuffer.clear(0.2, 0.4, 0.6, 1.0)
    window.context.scissor = (0, height - 10, 20, 10)  # GL counts rows from the bottom
    window.framebuffer.clear(1.0, 0.0, 0.0, 1.0)
    window.context.scissor = None
    pixels = window.read_pixels()
    assert pixels.shape == (height, width, 3)
    assert pixels.dtype == np.uint8
    np.testing.assert_array_equal(pixels[0, 0], [255, 0, 0])
    np.testing.assert_array_equal(pixels[9, 19], [255, 0, 0])
    np.testing.assert_array_equal(pixels[10, 20], [51, 102, 153])  # linear: no sRGB conversion on the way
    np.testing.assert_array_equal(pixels[-1, -1], [51, 102, 153])
    window.swap()


def test_a_new_size_reaches_framebuffer_and_viewport(window: Window) -> None:
    window.resize(333, 222)
    settle(window)
    assert window.size() == (333, 222)
    assert tuple(window.framebuffer.viewport) == (0, 0, 333, 222)
    window.framebuffer.use()
    window.framebuffer.clear(0.0, 1.0, 0.0, 1.0)
    assert (window.read_pixels() == [0, 255, 0]).all()


def test_a_new_size_counts_as_input(window: Window) -> None:
    settle(window)
    window.resize(500, 400)
    assert any(window.poll(0.05) for _ in range(40))


def test_wake_ends_a_wait_from_another_thread_and_is_no_input(window: Window) -> None:
    settle(window)
    waker = threading.Timer(0.05, window.wake)
    waker.start()
    begin = time.monotonic()
    came = window.poll(30.0)
    assert time.monotonic() - begin < 20  # it did not sleep to the end
    assert not came
    waker.join()


def test_a_request_to_close_is_seen(window: Window) -> None:
    assert not window.should_close()
    window.request_close()
    assert window.should_close()
    window.close()
    window.close()


def test_the_clipboard_keeps_text(window: Window) -> None:
    window.set_clipboard("σ = 1.5 → 日本")
    assert window.clipboard() == "σ = 1.5 → 日本"


def test_scale_and_cursor(window: Window) -> None:
    from imgui_bundle import imgui

    assert window.scale() >= 1
    for cursor in imgui.MouseCursor_:
        window.set_cursor(cursor)


def test_real_keys_and_buttons_reach_imgui(display: str, monkeypatch: pytest.MonkeyPatch, imgui_context: None) -> None:
    from imgui_bundle import imgui

    monkeypatch.setenv("DISPLAY", display)
    from viewer.window.glfw_window import GlfwWindow, glfw

    window = GlfwWindow("test", (320, 240))
    io = imgui.get_io()
    io.display_size = imgui.ImVec2(320, 240)
    io.backend_flags |= imgui.BackendFlags_.renderer_has_textures
    io.config_input_trickle_event_queue = False
    window._on_key(None, glfw.KEY_S, 0, glfw.PRESS, glfw.MOD_CONTROL)
    window._on_move(None, 12.0, 34.0)
    window._on_button(None, 0, glfw.PRESS, 0)
    imgui.new_frame()
    assert imgui.is_key_down(imgui.Key.s)
    assert imgui.is_mouse_down(0)
    assert (io.mouse_pos.x, io.mouse_pos.y) == (12, 34)
    imgui.end_frame()
    window.close()


def test_a_window_of_the_usual_size_fits_on_a_small_screen(
    display: str, monkeypatch: pytest.MonkeyPatch, imgui_context: None
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    from viewer.window import DEFAULT_SIZE
    from viewer.window.glfw_window import GlfwWindow, glfw

    monkeypatch.setattr(glfw, "get_monitor_workarea", lambda _: (0, 30, 1000, 700))
    for size, found in ((DEFAULT_SIZE, (1000, 700)), ((1200, 720), (1200, 720))):  # one that is asked for is kept
        window = GlfwWindow("test", size)
        settle(window)
        assert window.size() == found
        window.close()


def test_a_missing_display_is_an_error_of_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(DisplayError, match=r"cannot open a window: .*DISPLAY.*--headless") as caught:
        open_window("test")
    assert "\n" not in str(caught.value)


def test_training_and_drawing_share_one_process() -> None:
    """Triton's and Mesa's LLVM clash in a process that opens GL first. It would crash here, not raise."""
    script = """
from viewer.window import open_offscreen
window = open_offscreen((64, 64))
window.framebuffer.clear(1.0, 1.0, 1.0, 1.0)
import torch
torch.set_num_threads(1)
weight = torch.nn.Linear(3, 3)
optimiser = torch.optim.Adam(weight.parameters())
for _ in range(2):
    optimiser.zero_grad()
    weight(torch.ones(4, 3)).square().sum().backward()
    optimiser.step()
    window.framebuffer.clear(0.5, 0.5, 0.5, 1.0)
print(int(window.read_pixels()[0, 0, 0]), float(weight.weight.sum()) == float(weight.weight.sum()))
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        env=dict(os.environ),
        check=False,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["128", "True"]
