"""Names of files as text for people, and back."""

from __future__ import annotations

import os
import re
from pathlib import Path

# Control characters and line separators, what turns the direction of text, and lone surrogates. The last are what
# Python makes of bytes in a name that are not UTF-8, and cannot be encoded. All else stays, with joined emoji.
UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
ESCAPE = re.compile(r"\\(?:[nrt]|x[0-9a-f]{2}|u[0-9a-f]{4})")
LONE = 0xDC00  # such a byte b is the lone surrogate LONE + b (PEP 383); b is at least 0x80


def printable(text: str | os.PathLike[str]) -> str:
    r"""Return a path or a text as one line that can be drawn, printed and written as UTF-8.

    Args:
        text: a path, or a text with names in it.

    Returns:
        The same text, with each unprintable character as an escape: "\n", "\x1b", "\u202e", and "\xe9" for a byte that
        is not UTF-8. It is for people and for descriptions. What is to be opened again is stored as it is: JSON has
        escapes of its own that give each byte back.
    """
    found = os.fspath(text)
    return UNPRINTABLE.sub(_escaped, found) if UNPRINTABLE.search(found) else found  # a phrase stays one


def existing(path: Path) -> Path:
    """Return the existing file that a path names as `printable` shows it; the path itself if there is no such file.

    A text field cannot hold other names than printable ones.
    """
    if os.path.lexists(path) or not ESCAPE.search(str(path)):
        return path
    meant = Path(ESCAPE.sub(_character, str(path)))
    return meant if os.path.lexists(meant) else path


def _escaped(found: re.Match[str]) -> str:
    code = ord(found[0])
    if LONE + 0x80 <= code < LONE + 0x100:
        return f"\\x{code - LONE:02x}"
    return found[0].encode("unicode_escape").decode() if code < 0x80 else f"\\u{code:04x}"


def _character(found: re.Match[str]) -> str:
    kind, digits = found[0][1], found[0][2:]
    if not digits:
        return {"n": "\n", "r": "\r", "t": "\t"}[kind]
    code = int(digits, 16)
    return chr(LONE + code if kind == "x" and code >= 0x80 else code)
