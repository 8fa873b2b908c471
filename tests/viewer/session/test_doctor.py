"""What `--doctor` says of a machine on which the other tests run."""

from __future__ import annotations

from viewer.session.doctor import examine


def test_where_training_and_offscreen_drawing_work_it_says_so() -> None:
    said: list[str] = []
    assert examine(said.append)
    training, headless = (next(line for line in said if line.startswith(name)) for name in ("training", "headless"))
    assert training.split()[1] == headless.split()[1] == "ok"
    assert any("a step of" in line for line in said)
    assert said[-1] == "training and headless rendering work"
