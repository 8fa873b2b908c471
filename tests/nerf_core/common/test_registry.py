"""Defining a plug-in registers it; an unknown name is refused with the known ones."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from nerf_core.common.errors import UserError
from nerf_core.common.registry import Registry
from nerf_core.methods import METHODS


def test_an_unknown_name_lists_the_choices() -> None:
    with pytest.raises(UserError, match=r"unknown method 'nurf' \(did you mean nerf\?\): choose one of .*nerf"):
        METHODS.get("nurf")


def test_a_name_can_be_registered_once() -> None:
    registry: Registry[int] = Registry("number", "nerf_core.volume")
    registry.register("one")(1)
    with pytest.raises(ValueError, match="two numbers are called 'one'"):
        registry.register("one")(2)
    assert registry.names() == ("one",)
    assert registry.get("one") == 1


def test_a_broken_plugin_of_another_package_is_reported_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    broken = EntryPoint("broken", "no_such_module", "nerf_viewer.numbers")
    monkeypatch.setattr("nerf_core.common.registry.entry_points", lambda group: [broken])
    registry: Registry[int] = Registry("number", "nerf_core.volume", entry_points="nerf_viewer.numbers")
    assert registry.names() == registry.names() == ()
    assert caplog.messages == registry.problems
    (problem,) = registry.problems
    assert problem.startswith("the number broken of package ? cannot be loaded (ModuleNotFoundError")


def test_a_second_thread_waits_until_all_plugins_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    registry: Registry[int] = Registry("number", "nerf_core.volume", entry_points="nerf_viewer.numbers")
    begun, go_on = threading.Event(), threading.Event()

    class Slow:
        name = "slow"

        def load(self) -> None:
            assert registry.names() == ()  # a plug-in may ask while it is imported
            begun.set()
            assert go_on.wait(30)
            registry.register("one")(1)

    monkeypatch.setattr("nerf_core.common.registry.entry_points", lambda group: [Slow()])
    with ThreadPoolExecutor() as pool:
        first = pool.submit(registry.names)
        assert begun.wait(30)
        second = pool.submit(registry.get, "one")
        try:
            with pytest.raises(TimeoutError):
                second.result(timeout=0.05)
        finally:
            go_on.set()
        assert first.result() == ("one",)
        assert second.result() == 1
    assert registry.problems == []


def test_a_plugin_that_cannot_be_imported_is_told_at_every_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plugins_of_a_test").mkdir()
    (tmp_path / "plugins_of_a_test" / "__init__.py").touch()
    (tmp_path / "plugins_of_a_test" / "one.py").write_text("import no_such_module\n")
    monkeypatch.syspath_prepend(tmp_path)
    registry: Registry[int] = Registry("number", "plugins_of_a_test")
    for _ in range(2):
        with pytest.raises(ModuleNotFoundError, match="no_such_module"):
            registry.get("one")
