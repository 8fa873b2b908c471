"""A signal raises at once or is first noted, and earlier handlers are restored."""

from __future__ import annotations

import os
import signal

import pytest

from nerf_core.common.signals import Interrupted, Signals


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_raises_at_once_by_default(hangup: None, number: signal.Signals, status: int) -> None:
    with Signals(), pytest.raises(Interrupted) as caught:
        os.kill(os.getpid(), number)
    assert caught.value.status == status


def test_polite_notes_the_first_and_raises_at_the_second() -> None:
    now = 10.0
    with Signals(lambda: now) as signals:
        signals.be_polite()
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.received == signal.SIGTERM
        with pytest.raises(Interrupted, match="SIGTERM"):
            signals.check()
        os.kill(os.getpid(), signal.SIGINT)  # at the same moment: an echo, ignored
        now = 11.0
        with pytest.raises(Interrupted, match="SIGINT"):
            os.kill(os.getpid(), signal.SIGINT)


def test_takes_a_signal_back_from_a_library_that_took_it() -> None:
    with Signals() as signals:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signals.be_polite()
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.received == signal.SIGTERM


def test_earlier_handlers_are_restored() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with Signals():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_hangup_that_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Signals() as signals:
            signals.be_polite()
            os.kill(os.getpid(), signal.SIGHUP)
            assert signals.received is None
    finally:
        signal.signal(signal.SIGHUP, before)
