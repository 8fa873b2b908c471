"""Read a tour: a folder of Markdown files, a step each, with directives on lines that begin with @.

docs/tours.md describes the format. A tour is data: nothing of it is run as code.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from nerf_core.common.errors import UserError, shorten
from nerf_core.common.names import printable

from .conditions import Condition, condition
from .deeds import DEEDS, Deed
from .values import VALUES

MOST_BYTES = 100_000  # of a step: a longer one is no step
MOST_STEPS = 200
PROSE = {"try", "question", "answer", "note"}  # go on over the lines that follow, to an empty one
FIELD = re.compile(r"\{(\w*)\}")


@dataclass(frozen=True)
class Prose:
    """A paragraph, a list's item or small print, with *emphasis*, **strong** and `code`."""

    text: str
    kind: str = "paragraph"  # or "item", "note"


@dataclass(frozen=True)
class Equation:
    """A line of symbols; names in braces are live values."""

    text: str


@dataclass(frozen=True)
class Task:
    """Something to do, and when it is done; None: the program cannot tell."""

    text: str
    until: Condition | None = None


@dataclass(frozen=True)
class Question:
    """A question; its answer is shown on a button."""

    text: str
    answer: str = ""


Block = Prose | Equation | Task | Question


@dataclass(frozen=True)
class Step:
    """A step of a tour.

    name: of its file, without the suffix.
    title: its first line.
    blocks: what is shown, from top to bottom.
    deeds: what is done when it is shown, in this order.
    panels: the titles of the panels that it names.
    page: the title of the panel that is shown alone; empty: none.
    """

    name: str
    title: str
    blocks: tuple[Block, ...]
    deeds: tuple[Deed, ...]
    panels: tuple[str, ...]
    page: str = ""

    @property
    def tasks(self) -> tuple[Task, ...]:
        return tuple(block for block in self.blocks if isinstance(block, Task))


def read_tour(folder: Path) -> tuple[Step, ...]:
    """Return the steps of a folder, in the order of their files' names. Raises UserError with file and line."""
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix == ".md" and not file.name.startswith("."))
    except OSError as error:
        raise UserError(f"{printable(folder)}: is no folder of a tour ({error.strerror})") from None
    if not files:
        raise UserError(f"{printable(folder)}: holds no step of a tour: write files such as 01-cameras.md")
    if len(files) > MOST_STEPS:
        raise UserError(f"{printable(folder)}: holds {len(files):,} .md files: a tour has {MOST_STEPS} at most")
    return tuple(read_step(file) for file in files)


def read_step(file: Path) -> Step:
    """Read one file. Raises UserError with file and line."""
    try:
        with file.open("rb") as opened:
            data = opened.read(MOST_BYTES + 1)
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(f"{printable(file)}: is not written in UTF-8: save it as UTF-8") from None
    except OSError as error:
        raise UserError(f"{printable(file)}: cannot be read ({error.strerror})") from None
    if len(data) > MOST_BYTES:
        raise UserError(f"{printable(file)}: is longer than {MOST_BYTES:,} bytes: split it into steps")
    return parse_step(text, file.stem, printable(file))


def parse_step(text: str, name: str, where: str) -> Step:
    """Return the step that a text describes.

    Args:
        text: of the file.
        name: of the step.
        where: the file, for errors.

    Raises:
        UserError: file and line, what is wrong, what to write.
    """
    lines = text.splitlines()
    title = lines[0].removeprefix("#").strip() if lines and lines[0].startswith("# ") else ""
    if not title:
        raise UserError(f"{where}:1: begin with the step's title, such as: # The ray")
    blocks: list[Block] = []
    deeds: list[Deed] = []
    panels: list[str] = []
    for line, word, rest in _pieces(lines[1:], 2):
        try:
            if word in DEEDS:
                deed = DEEDS[word](rest)
                deeds.append(deed)
                panels += [deed.panel] if deed.panel else []
            else:
                _add(blocks, word, rest)
        except ValueError as error:
            raise UserError(f"{where}:{line}: @{word} {shorten(rest)}: {error}") from None
    if not blocks:
        raise UserError(f"{where}: has a title and no text: write what the reader should know")
    page = next((deed.page for deed in deeds if deed.page), "")
    return Step(name, title, tuple(blocks), tuple(deeds), tuple(panels), page)


def _pieces(lines: list[str], first: int) -> Iterator[tuple[int, str, str]]:
    """The parts of a text: the number of the line, the directive's name, and the rest.

    A paragraph is called "paragraph", an item of a list "item".
    """
    word, number, held = "", first, list[str]()
    for line, whole in enumerate([*lines, ""], first):
        text = whole.strip()
        directive = re.match(r"@(\w*)\s*(.*)", text)
        item = text.startswith("- ")
        if held and (not text or directive or item):
            yield number, word, " ".join(held)
            held = []
        if directive:
            word, number = directive[1], line
            if word in PROSE and directive[2]:
                held = [directive[2]]
            else:
                yield line, word, directive[2]
        elif text:
            if not held:
                word, number = ("item" if item else "paragraph"), line
            held.append(text.removeprefix("- ") if item else text)


def _add(blocks: list[Block], word: str, text: str) -> None:
    """Add what is shown. Raises ValueError with what to write."""
    last = blocks[-1] if blocks else None
    match word:
        case "paragraph" | "item" | "note":
            blocks.append(Prose(_given(text), word))
        case "equation":
            unknown = [field for field in FIELD.findall(_given(text)) if field not in VALUES]
            if unknown:
                raise ValueError(f"{{{unknown[0]}}} is no value: choose of {', '.join(VALUES)}")
            blocks.append(Equation(text))
        case "try":
            blocks.append(Task(_given(text)))
        case "until":
            if not isinstance(last, Task) or last.until is not None:
                raise ValueError("write it once, after @try")
            blocks[-1] = Task(last.text, condition(text))
        case "question":
            blocks.append(Question(_given(text)))
        case "answer":
            if not isinstance(last, Question) or last.answer:
                raise ValueError("write it once, after @question")
            blocks[-1] = Question(last.text, _given(text))
        case _:
            known = sorted([*DEEDS, *PROSE, "equation", "until"])
            raise ValueError(f"there is no such directive: choose of {', '.join(known)}")


def _given(text: str) -> str:
    if not text:
        raise ValueError("write a text after it")
    return text
