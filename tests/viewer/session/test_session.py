"""A session without its command line."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

from nerf_core.common.signals import Signals
from nerf_core.datasets.capture import DATASETS
from nerf_core.methods import METHODS
from nerf_core.training.settings import RunSettings
from viewer.session.session import Session
from viewer.session.wishes import Wishes
from viewer.window import Window


def test_the_window_shows_which_plugins_cannot_be_loaded(
    offscreen: Callable[..., Window], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(METHODS, "problems", ["the method nope cannot be loaded"])
    monkeypatch.setattr(DATASETS, "problems", ["the dataset never cannot be loaded"])
    with Signals() as signals:
        session = Session(offscreen((320, 200)), RunSettings(), signals, print)
        try:
            signals.received = signal.SIGTERM  # so that the window closes at once
            session._attend(Wishes())
            notices = [shown.notice for shown in session.app.state.notices]
        finally:
            session.close()
    assert [(one.level, one.text) for one in notices] == [
        ("warning", "the method nope cannot be loaded"),
        ("warning", "the dataset never cannot be loaded"),
    ]
