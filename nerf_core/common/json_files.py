"""Read calibration files in JSON: with a BOM, with comments, damaged, or something else altogether."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import phrases

MAX_BYTES = 64_000_000  # ten thousand frames take about 10 MB; parsing takes some ten times a file's size
MAX_VALUES = 2_000_000  # ten thousand frames with a lens each hold 400,000; a parsed value takes some 60 bytes
LIMIT = 1e12  # beyond any unit of length; products of three such numbers still are finite in float64
TEXT_OR_COMMENT = re.compile(r'("(?:[^"\\]|\\.)*+"?)|//[^\n]*', re.DOTALL)
STRETCH = 1.05  # a larger ratio between the lengths of a rotation's axes is a shear, not rounding
LENGTH_TOLERANCE = 1e-3  # files round rotations to 4 digits and more


class Fields:
    """One object of a JSON file with typed access. Every error names the file and the field."""

    def __init__(self, values: dict[str, Any], file: Path, where: str = "") -> None:
        self.values, self.file, self.where = values, file, where

    def __contains__(self, key: str) -> bool:
        return self.values.get(key) is not None

    def error(self, key: str, expected: str) -> UserError:
        return UserError(f"{self.file}: {self.where}{key} is {shorten(self.values.get(key))}: {expected}")

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number, or `default` where the field is absent or null. Raises UserError."""
        value = self.values.get(key)
        if value is None:
            if default is None:
                raise UserError(f"{self.file}: {self.where}{key} is missing: add it")
            return default
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, "a number is needed")
        if abs(value) > LIMIT:
            raise self.error(key, f"a number between ±{LIMIT:g} is needed")
        return float(value)

    def positive(self, key: str) -> float:
        value = self.number(key)
        if value <= 0:
            raise self.error(key, "a number above 0 is needed")
        return value

    def count(self, key: str) -> int:
        """Return a whole number of at least 1; the file may write it as a float."""
        value = self.positive(key)
        if value != round(value):
            raise self.error(key, "a whole number is needed")
        return round(value)

    def text(self, key: str) -> str:
        value = self.values.get(key)
        if not isinstance(value, str) or not value:
            raise self.error(key, "a text is needed")
        return value

    def texts(self, key: str) -> list[str]:
        value = self.values.get(key)
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise self.error(key, "a list of texts is needed")
        return value

    def children(self, key: str) -> list[Fields]:
        """Return the objects of a list, which must not be empty."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value:
            raise self.error(key, "a list with at least one entry is needed")
        for i, child in enumerate(value):
            if not isinstance(child, dict):
                raise UserError(f"{self.file}: {self.where}{key}[{i}] is {shorten(child)}: an object is needed")
        return [Fields(child, self.file, f"{self.where}{key}[{i}].") for i, child in enumerate(value)]

    def pose(self, key: str) -> tuple[np.ndarray, float]:
        """Return camera-to-world (3, 4) with an exact rotation, and the length that its axes had in the file.

        Rows are 3 or 4 lists of 4 numbers. Raises UserError for singular, sheared and mirrored axes.
        """
        rows = self.values.get(key)
        shape = "a matrix of 3 or 4 rows with 4 numbers each is needed"
        if not isinstance(rows, list) or len(rows) not in (3, 4):
            raise self.error(key, shape)
        for row in rows:
            if not isinstance(row, list) or len(row) != 4:
                raise self.error(key, shape)
            if not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= LIMIT for v in row):
                raise UserError(f"{self.file}: {self.where}{key} has a row {shorten(row)}: 4 numbers are needed")
        if len(rows) == 4 and [float(v) for v in rows[3]] != [0, 0, 0, 1]:
            raise UserError(f"{self.file}: {self.where}{key} ends with {shorten(rows[3])}: the last row is 0, 0, 0, 1")
        matrix = np.array(rows[:3], dtype=np.float64)
        u, lengths, vt = np.linalg.svd(matrix[:, :3])
        if lengths[2] <= 1e-6 * lengths[0]:
            raise self.error(key, "its axes are singular; a rotation is needed")
        if lengths[0] > STRETCH * lengths[2]:
            raise self.error(key, "its axes are sheared; a rotation is needed")
        rotation = u @ vt  # the nearest rotation (polar decomposition)
        if np.linalg.det(rotation) < 0:
            raise self.error(key, "its axes are mirrored; a rotation is needed")
        return np.concatenate([rotation, matrix[:, 3:]], axis=1), float(lengths.mean())


def scaled_note(file: Path, lengths: list[float]) -> list[str]:
    """Return a warning about rotations whose axes were not of unit length; none if all were."""
    odd = [length for length in lengths if abs(length - 1) > LENGTH_TOLERANCE]
    if not odd:
        return []
    return [
        phrases(
            "{file}: {n} pose has scaled axes (length {length:.4g}); its rotation is taken without scale",
            "{file}: {n} poses have scaled axes (length {length:.4g}); their rotation is taken without scale",
            len(odd),
            file=file,
            length=odd[0],
        )
    ]


def read_json(file: Path, needed: str = "an object with frames") -> Fields:
    """Read a JSON object. A BOM, UTF-16 and // comments are accepted.

    Args:
        file: the file.
        needed: what the file must hold, for the error message.

    Raises:
        UserError: for everything that is not a JSON object, and for a number that is not finite, used or not.
    """
    if not file.is_file():
        raise UserError(f"{file} is not a regular file: name an existing .json file")
    if file.stat().st_size > MAX_BYTES:
        raise UserError(
            f"{file} has {file.stat().st_size:,} bytes: no calibration is that large, is it the right file?"
        )
    data = file.read_bytes()
    try:
        text = data.decode(json.detect_encoding(data)).strip()
    except UnicodeDecodeError as error:
        raise UserError(f"{file} is not text ({error.reason} at byte {error.start}): is it the right file?") from error
    # Every value but the first follows a comma or an opening bracket, so that counting these bounds the memory.
    values = text.count(",") + text.count("[") + text.count("{")
    if values > MAX_VALUES:
        raise UserError(
            f"{file} holds about {values:,} values, {MAX_VALUES:,} are allowed: no calibration has so many, is it the "
            "right file?"
        )
    if not text:
        raise UserError(f"{file} is empty: download or export it again")
    if text.startswith("<"):
        raise UserError(f"{file} is a web page, not JSON: download the file itself")
    values = _parsed(TEXT_OR_COMMENT.sub(lambda m: m[1] or "", text), file)
    if not isinstance(values, dict):
        raise UserError(f"{file} holds {shorten(values)}: {needed} is needed")
    _refuse_infinite(values, file)
    return Fields(values, file)


def _parsed(text: str, file: Path) -> Any:
    try:
        return json.loads(text, parse_int=_integer)
    except json.JSONDecodeError as error:
        raise UserError(
            f"{file} breaks off or is no JSON at line {error.lineno}, column {error.colno} ({error.msg}): "
            "download or export it again"
        ) from error
    except RecursionError as error:
        raise UserError(f"{file} is nested too deeply to be a calibration: download or export it again") from error


def _integer(digits: str) -> int | float:
    """Parse thousands of digits, which int() refuses, as an infinite float; the caller's error then names the field."""
    return int(digits) if len(digits) < 300 else float(digits)


def _refuse_infinite(values: dict[str, Any], file: Path) -> None:
    way: list[tuple[str, Iterator[tuple[Any, Any]]]] = [("", iter(values.items()))]  # names and what is left of each
    while way:
        for key, value in way[-1][1]:
            if isinstance(value, float) and not math.isfinite(value):
                where = "".join(name for name, _ in way) + _step(key)
                raise UserError(f"{file}: {shorten(where.removeprefix('.'))} is {value}: a finite number is needed")
            if isinstance(value, dict):
                way.append((_step(key), iter(value.items())))
                break
            if isinstance(value, list):
                way.append((_step(key), enumerate(value)))
                break
        else:
            way.pop()


def _step(key: str | int) -> str:
    return f"[{key}]" if isinstance(key, int) else f".{key}"


def finite(value: Any) -> Any:
    """Make a value fit for strict JSON: NaN and infinity become null, arrays become lists."""
    if isinstance(value, np.ndarray):
        return finite(value.tolist())
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
