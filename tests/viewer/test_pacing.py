"""When frames are drawn, on a clock of our own."""

from __future__ import annotations

from viewer.pacing import FASTEST, FIGURES, PICTURE, SETTLE_SECONDS, Pacer


def frames(pacer: Pacer, seconds: float, *, start: float = 100.0, **news: bool) -> int:
    """How many are drawn in a stretch of time in which there is always something new of this kind."""
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
    assert frames(Pacer(), 2, hand=True) in range(round(2 / FASTEST) - 6, round(2 / FASTEST) + 2)
    assert frames(Pacer(), 2, picture=True) in range(round(2 / PICTURE) - 2, round(2 / PICTURE) + 2)
    assert frames(Pacer(), 2, figures=True) in range(round(2 / FIGURES) - 2, round(2 / FIGURES) + 2)


def test_offscreen_only_a_hand_is_drawn_fast() -> None:
    for news in ({"picture": True}, {"figures": True}):
        assert frames(Pacer(watched=False), 5, **news) in (5, 6)
    assert frames(Pacer(watched=False), 1, hand=True) > 50


def test_input_is_drawn_at_once_and_settles() -> None:
    pacer = Pacer()
    pacer.note(50.0, hand=True)
    assert pacer.due(50.0)
    drawn = frames(pacer, 10, start=50.0)
    assert 4 <= drawn < 4 + SETTLE_SECONDS / 0.1 + 2  # then it is quiet


def test_the_wait_ends_when_a_frame_is_due() -> None:
    pacer = Pacer()
    assert 0 < pacer.wait(10.0) <= PICTURE  # idle: look again soon, without drawing
    pacer.note(10.0, hand=True)
    assert pacer.wait(10.0) == 0
    pacer.drew(10.0)
    assert 0 < pacer.wait(10.001) <= FASTEST
