"""The report of `--doctor` on a machine where the other tests run."""

from __future__ import annotations

from viewer.session.doctor import examine


def test_the_doctor_reports_that_training_and_offscreen_drawing_work() -> None:
    lines: list[str] = []
    assert examine(lines.append)
    training, headless = (next(line for line in lines if line.startswith(name)) for name in ("training", "headless"))
    assert training.split()[1] == headless.split()[1] == "ok"
    assert any("a step of" in line for line in lines)
    assert lines[-1] == "training and headless rendering work"
