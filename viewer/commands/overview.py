"""List everything that mouse and keys do, for the help and for the table in the documentation."""

from __future__ import annotations

from .pointer import GESTURES
from .registry import SECTIONS, Section, commands


def overview() -> list[tuple[Section, list[tuple[str, str]]]]:
    """Return every section that has rows, with its rows: what is done, and by which gesture or keys."""
    rows: dict[Section, list[tuple[str, str]]] = {section: [] for section in SECTIONS}
    for gesture in GESTURES:
        rows[gesture.section].append((gesture.title, gesture.how))
    for command in commands():
        if command.keys:
            rows[command.section].append((command.title, ", ".join(command.keys)))
    return [(section, lines) for section, lines in rows.items() if lines]
