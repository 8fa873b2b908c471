"""A method's constants: a frozen dataclass of numbers, changed by name, checked, stored as JSON."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, TypeVar, get_type_hints

from nerf_core.common.errors import UserError, shorten

C = TypeVar("C")
WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


def check_ranges(config: Any, least: Mapping[str, float], most: Mapping[str, float]) -> None:
    """Raises UserError for a number below `least` (0 where it says nothing), above `most`, or none at all."""
    for f in fields(config):
        value = getattr(config, f.name)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            continue
        low, high = least.get(f.name, 0), most.get(f.name, sys.float_info.max)
        if not value >= low and not (f.name not in least and f.name.startswith("bias")):
            raise UserError(f"--set {f.name}={value}: must be at least {low}")
        if value > high:
            raise UserError(f"--set {f.name}={shorten(value)}: must be at most {high}")
        if not math.isfinite(value):
            raise UserError(f"--set {f.name}={value}: must be a finite number")


def changed(config: C, changes: Mapping[str, str], method: str) -> C:
    """The configuration with `changes` ({"rays": "256"}). Raises UserError for names and values that do not exist."""
    kinds = {name: kind for name, kind in get_type_hints(type(config)).items() if kind in WORDS}
    values: dict[str, Any] = {}
    for name, text in changes.items():
        if name not in kinds:
            raise UserError(f"--set {shorten(name)}: method {method} has no such constant; it has {', '.join(kinds)}")
        kind = kinds[name]
        try:
            if kind is bool:
                values[name] = {"true": True, "false": False}[text.lower()]
            else:
                values[name] = kind(text)
        except (ValueError, KeyError):
            raise UserError(f"--set {name}={shorten(text)}: expected {WORDS[kind]}") from None
    return replace(config, **values)  # pyright: ignore[reportArgumentType]: C is one of the configurations


def restored(kind: type[C], config: Mapping[str, Any], method: str) -> C:
    """The configuration that a checkpoint stores as a JSON object. Raises UserError where it is of another version."""
    names = {f.name for f in fields(kind)}  # pyright: ignore[reportArgumentType]
    if set(config) != names:
        odd = sorted(set(config) ^ names)
        raise UserError(f"the checkpoint's {method} configuration differs in {', '.join(odd)}: made by another version")
    for name, wanted in get_type_hints(kind).items():
        if not (type(config[name]) is wanted or (wanted is float and type(config[name]) is int)):
            raise UserError(
                f"the checkpoint's {name} is {shorten(config[name])}, no {wanted.__name__}: made by another version"
            )
    return kind(**config)
