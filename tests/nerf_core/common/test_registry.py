"""Definition is registration; a wrong name lists the right ones."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest

from nerf_core.common.errors import UserError
from nerf_core.common.registry import Registry
from nerf_core.methods import METHODS


def test_an_unknown_name_is_told_the_choices() -> None:
    with pytest.raises(UserError, match=r"unknown method 'nurf': choose one of .*nerf"):
        METHODS.get("nurf")


def test_a_name_is_taken_once() -> None:
    registry: Registry[int] = Registry("number", "nerf_core.volume")
    registry.register("one")(1)
    with pytest.raises(ValueError, match="two numbers are called 'one'"):
        registry.register("one")(2)
    assert registry.names() == ("one",)
    assert registry.get("one") == 1


def test_a_broken_plugin_of_another_package_is_told_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    broken = EntryPoint("broken", "no_such_module", "nerf_viewer.numbers")
    monkeypatch.setattr("nerf_core.common.registry.entry_points", lambda group: [broken])
    registry: Registry[int] = Registry("number", "nerf_core.volume", entry_points="nerf_viewer.numbers")
    assert registry.names() == registry.names() == ()
    assert caplog.messages == registry.problems
    (problem,) = registry.problems
    assert problem.startswith("the number broken of package ? cannot be loaded (ModuleNotFoundError")
