"""A method's constants: a frozen dataclass whose fields declare default, range and help in one place.

They are changed by name, checked when the object is made, and stored as JSON.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar, get_type_hints

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import phrase
from nerf_core.common.text import closest

C = TypeVar("C")
WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


LARGEST = sys.float_info.max
SHARES = {"[0, 1)": "must lie in [0, 1)", "(0, 1]": "must lie in (0, 1]", "(0, 1)": "must lie between 0 and 1"}


@dataclass(frozen=True)
class Constant:
    """The help and the allowed values of one field of a configuration.

    help: one line for people.
    least, most: the range of a number, both ends included.
    share: an interval between 0 and 1 as a key of SHARES; empty: the range above is all that counts.
    choices: the allowed words; empty: the field is a number, a truth value, or a text that its owner checks.
    """

    help: str
    least: float = 0.0
    most: float = LARGEST
    share: str = ""
    choices: tuple[str, ...] = ()

    @property
    def range(self) -> str:
        """The allowed values, a phrase for people; empty where every value is allowed."""
        if self.choices:
            found, *others = self.choices
            for last in others:
                found = phrase("{some} or {last}", some=found, last=last)
            return found
        if self.share:
            return self.share
        if self.least == 0 and self.most == LARGEST:
            return ""
        if self.most == LARGEST:
            return "" if self.least == -LARGEST else phrase("from {low:,g}", low=self.least)
        if self.least == -LARGEST:
            return phrase("to {high:,.10g}", high=self.most)
        return phrase("from {low:,g} to {high:,.10g}", low=self.least, high=self.most)


def constant(
    default: Any, help: str, *, least: float = 0.0, most: float = LARGEST, share: str = "", choices: Sequence[str] = ()
) -> Any:
    """Declare a field of a configuration with its default, its range and one line of help; see `Constant`."""
    return field(default=default, metadata={"constant": Constant(help, least, most, share, tuple(choices))})


def constants(kind: type[Any]) -> dict[str, tuple[Any, Constant]]:
    """List the fields of a configuration.

    Returns:
        {name: (default, Constant)}. The fields of a nested configuration are named outer.inner.
    """
    found: dict[str, tuple[Any, Constant]] = {}
    for f in fields(kind):
        if "constant" in f.metadata:
            found[f.name] = f.default, f.metadata["constant"]
        elif isinstance(f.default_factory, type) and is_dataclass(f.default_factory):
            inner = constants(f.default_factory)
            found |= {f"{f.name}.{name}": value for name, value in inner.items()}
    return found


def check_ranges(config: Any) -> None:
    """Raise UserError for a field outside its declared range, and for one that is NaN or infinite."""
    for f in fields(config):
        _check_range(f.name, getattr(config, f.name), f.metadata.get("constant"))


def _check_range(name: str, value: Any, known: Constant | None) -> None:
    """Raise UserError if a field's value is outside its declared range. known: None: it has none."""
    if known is None or isinstance(value, bool):
        return
    if known.choices:
        if value not in known.choices:
            raise UserError(f"--set {name}={shorten(value)}: choose {' or '.join(known.choices)}")
        return
    if isinstance(value, str):  # a text that its owner checks
        return
    if not value >= known.least:
        raise UserError(f"--set {name}={value}: must be at least {known.least:g}")
    if value > known.most:
        raise UserError(f"--set {name}={shorten(value)}: must be at most {known.most:.10g}")
    if not math.isfinite(value):
        raise UserError(f"--set {name}={value}: must be a finite number")
    if known.share and not _in_share(value, known.share):
        raise UserError(f"--set {name}={value}: {SHARES[known.share]}")


def _in_share(value: float, share: str) -> bool:
    low = value >= 0 if share[0] == "[" else value > 0
    return low and (value <= 1 if share[-1] == "]" else value < 1)


def changed(config: C, changes: Mapping[str, str], method: str) -> C:
    """Return the configuration with some constants changed.

    Args:
        config: the configuration; it stays as it is.
        changes: new values as text, such as {"rays": "256"}.
        method: the method's name in messages.

    Raises:
        UserError: for a name that does not exist, and for a value that cannot be parsed or is out of range.
    """
    kinds = {name: kind for name, kind in _kinds(type(config)).items() if "." not in name}
    values = {name: _parsed(name, text, kinds, method) for name, text in changes.items()}
    return replace(config, **values)  # pyright: ignore[reportArgumentType]: C is one of the configurations


def check_changes(kind: type[Any], changes: Mapping[str, str], method: str) -> None:
    """Check changes of constants before there is a scene to configure the method for.

    Args:
        kind: the configuration's class.
        changes: new values as text by name; those of a nested configuration are named outer.inner.
        method: the method's name in messages.

    Raises:
        UserError: for a name that does not exist, and for a value that cannot be parsed or is out of range.
    """
    kinds, known = _kinds(kind), constants(kind)
    for name, text in changes.items():
        value = _parsed(name, text, kinds, method)
        _check_range(name, value, known[name][1] if name in known else None)


def check_preset(presets: Sequence[str], preset: str, method: str) -> None:
    """Raise UserError for a preset that a method does not have, before there is a scene to configure the method for.

    Args:
        presets: the names of the method's presets besides "auto".
        preset: the one that is asked for.
        method: the method's name in messages.
    """
    if preset in ("auto", *presets):
        return
    asked = f"--preset {shorten(preset)}"
    if not presets:
        raise UserError(f"{asked}: method {method} has none but auto; change constants with --set")
    near = closest(preset, presets)
    other = f"did you mean {near}?" if near else f"it has auto, {', '.join(presets)}"
    raise UserError(f"{asked}: method {method} has no such preset; {other}")


def _kinds(kind: type[Any]) -> dict[str, type]:
    """The types of all fields that can be changed by name; those of a nested configuration are named outer.inner."""
    found: dict[str, type] = {}
    hints = get_type_hints(kind)
    for f in fields(kind):
        if hints[f.name] in WORDS:
            found[f.name] = hints[f.name]
        elif isinstance(f.default_factory, type) and is_dataclass(f.default_factory):
            found |= {f"{f.name}.{name}": inner for name, inner in _kinds(f.default_factory).items()}
    return found


def _parsed(name: str, text: str, kinds: Mapping[str, type], method: str) -> Any:
    """The value of a constant. kinds: the types of all constants. Raises UserError."""
    if name not in kinds:
        near = closest(name, kinds)
        other = f"did you mean {near}?" if near else f"it has {', '.join(kinds)}"
        raise UserError(f"--set {shorten(name)}: method {method} has no such constant; {other}")
    kind = kinds[name]
    try:
        return {"true": True, "false": False}[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        raise UserError(f"--set {name}={shorten(text)}: expected {WORDS[kind]}") from None


def restored(kind: type[C], config: Mapping[str, Any], method: str) -> C:
    """Rebuild the configuration that a checkpoint stores as a JSON object.

    Args:
        kind: the configuration's class.
        config: the JSON object.
        method: the method's name in messages.

    Raises:
        UserError: where names or types differ, as in a checkpoint of another version.
    """
    names = {f.name for f in fields(kind)}  # pyright: ignore[reportArgumentType]
    if set(config) != names:
        odd = sorted(set(config) ^ names)
        named = ", ".join(odd)[:200]
        raise UserError(f"the checkpoint's {method} configuration differs in {named}: made by another version")
    for name, wanted in get_type_hints(kind).items():
        if not (type(config[name]) is wanted or (wanted is float and type(config[name]) is int)):
            raise UserError(
                f"the checkpoint's {name} is {shorten(config[name])}, no {wanted.__name__}: made by another version"
            )
    return kind(**config)
