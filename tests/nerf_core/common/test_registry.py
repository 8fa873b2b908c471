"""Definition is registration; a wrong name lists the right ones."""

from __future__ import annotations

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
