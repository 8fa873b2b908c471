"""Numbers, durations and rates as text."""

from __future__ import annotations

import numpy as np

from nerf_core.common.text import duration, number, rate, size, triple, vector


def test_texts_of_figures() -> None:
    spans = {0.44: "0.4 s", 59.6: "1 min 0 s", 70.2: "1 min 10 s", 7500: "2 h 5 min", None: "–", float("nan"): "–"}
    for seconds, text in spans.items():
        assert duration(seconds) == text
    assert [rate(v) for v in (0.0, 512.0, 640_123.0, 1.254e6)] == ["–", "512", "640k", "1.25M"]
    assert [number(v) for v in (None, float("inf"), -0.00012345, 3.0)] == ["–", "–", "−0.0001234", "3"]
    assert vector(np.array([0.5, -1.25])) == " 0.500 −1.250"
    assert triple(np.array([0.5, -1.25, 0.0])) == "0.500 −1.250 0.000"
    sizes = {0: "0 B", 999: "999 B", 12_345: "12.3 kB", 999_900: "1 MB", 512_400_000: "512 MB", 1.234e9: "1.23 GB"}
    assert {count: size(count) for count in sizes} == sizes


def test_zero_has_no_sign() -> None:
    assert vector(np.array([-0.0001, -0.0, 0.0, -0.0006])) == " 0.000  0.000  0.000 −0.001"
    assert number(-0.0) == "0"
