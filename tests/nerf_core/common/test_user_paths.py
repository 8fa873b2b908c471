"""Paths with a ~ that no shell has expanded, anywhere on a command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import pytest
import tyro

from nerf_core.common.command_line import parse
from nerf_core.common.errors import UserError


@dataclass(frozen=True)
class Inner:
    save: Path | None = None


@dataclass(frozen=True)
class Outer:
    inner: Inner
    data: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="DATA")] = None
    write: list[Path] = field(default_factory=list)
    name: str = ""


def test_the_home_folder_is_expanded_in_every_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    found = parse(
        Outer, "x", ["~/photos", "--save=~/a.ckpt", "--write", "~/b.json", "--write", "c~.csv", "--name", "a~"]
    )
    assert found == Outer(Inner(tmp_path / "a.ckpt"), tmp_path / "photos", [tmp_path / "b.json", Path("c~.csv")], "a~")


def test_an_unknown_user_is_reported() -> None:
    with pytest.raises(UserError, match="no such user"):
        parse(Outer, "x", ["--save", "~nobody-by-this-name/a.ckpt"])
