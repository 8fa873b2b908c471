"""Work in pieces: generators that yield how far they are and return their result."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, TypeVar

P = TypeVar("P")
Q = TypeVar("Q")
R = TypeVar("R")


def finished(work: Generator[P, Any, R], each: Callable[[P], object] = lambda piece: None) -> R:
    """Do all of the work and return its result. each: called with what every piece yields; it may raise to cancel."""
    while True:
        try:
            piece = next(work)
        except StopIteration as end:
            return end.value
        each(piece)


def mapped(work: Generator[P, Any, R], turn: Callable[[P], Q]) -> Generator[Q, None, R]:
    """Do the same work, but yield `turn(piece)` for each of its pieces. Closing it closes the work."""
    try:
        while True:
            try:
                piece = next(work)
            except StopIteration as end:
                return end.value
            yield turn(piece)
    finally:
        work.close()
