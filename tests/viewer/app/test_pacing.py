"""When frames are drawn, in simulated time."""

from __future__ import annotations

import pytest

from viewer.app.pacing import FASTEST, FIGURES, PICTURE, SETTLE_SECONDS, SLOWEST, Pacer


def frames(pacer: Pacer, seconds: float, *, start: float = 100.0, **news: bool) -> int:
    """Count the frames drawn in `seconds` in which there is always something new of this kind."""
    count, step = 0, 0.001
    for k in range(round(seconds / step)):
        now = start + k * step
        pacer.note(now, **news)
        if pacer.due(now):
            pacer.drew(now)
            count += 1
    return count


def test_nothing_new_draws_nothing() -> None:
    assert frames(Pacer(), 5) == 0


def test_each_kind_of_news_has_its_own_cap() -> None:
    assert frames(Pacer(), 2, user=True) in range(round(2 / FASTEST) - 6, round(2 / FASTEST) + 2)
    assert frames(Pacer(), 2, picture=True) in range(round(2 / PICTURE) - 2, round(2 / PICTURE) + 2)
    assert frames(Pacer(), 2, figures=True) in range(round(2 / FIGURES) - 2, round(2 / FIGURES) + 2)


def test_offscreen_only_input_is_drawn_fast() -> None:
    for news in ({"picture": True}, {"figures": True}):
        assert frames(Pacer(watched=False), 5, **news) in (5, 6)
    assert frames(Pacer(watched=False), 1, user=True) > 50


def test_input_is_drawn_at_once_and_settles() -> None:
    pacer = Pacer()
    pacer.note(50.0, user=True)
    assert pacer.due(50.0)
    drawn = frames(pacer, 10, start=50.0)
    assert 4 <= drawn < 4 + SETTLE_SECONDS / 0.1 + 2  # then it is quiet


def test_an_answer_is_drawn_at_once_and_alone() -> None:
    pacer = Pacer()
    pacer.note(50.0, picture=True)
    pacer.drew(50.0)
    pacer.note(50.02, picture=True)
    assert not pacer.due(50.02)
    pacer.note(50.02, answer=True)
    assert pacer.due(50.02)
    assert pacer.wait(50.02) == 0
    assert frames(pacer, 1, start=50.02) == 1


def test_the_wait_ends_when_a_frame_is_due() -> None:
    pacer = Pacer()
    assert 0 < pacer.wait(10.0) <= PICTURE  # idle: look again soon, without drawing
    pacer.note(10.0, user=True)
    assert pacer.wait(10.0) == 0
    pacer.drew(10.0)
    assert 0 < pacer.wait(10.001) <= FASTEST


def test_slow_frames_keep_to_their_share_of_the_time() -> None:
    def per_second(seconds: float, part: float) -> float:
        pacer, drawn, now = Pacer(), 0, 0.0
        while now < 10:
            pacer.note(now, user=True)
            if pacer.due(now):
                now += seconds
                pacer.drew(now - seconds, seconds, part)
                drawn += 1
            else:
                now += 0.001
        return drawn / 10

    assert per_second(0.008, 1.0) == pytest.approx(1 / FASTEST, rel=0.1)
    assert per_second(0.002, 0.2) == pytest.approx(1 / FASTEST, rel=0.1)
    assert 0.008 * per_second(0.008, 0.2) == pytest.approx(0.2, rel=0.1)
    assert per_second(0.04, 0.2) == pytest.approx(1 / SLOWEST, rel=0.1)


def test_a_picture_that_the_user_waits_for_is_shown_at_once() -> None:
    pacer = Pacer()
    for k in range(50):
        pacer.drew(k / 20, 0.04, 0.2)
    pacer.note(2.47, user=True)
    assert not pacer.due(2.47)
    pacer.note(2.47, picture=True)
    assert pacer.due(2.47)
