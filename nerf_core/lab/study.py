"""The interface of studies, and where they work."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, runtime_checkable

from nerf_core.common.configs import check_ranges
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.language import digits, marked, phrase, phrases
from nerf_core.common.registry import Registry
from nerf_core.datasets import LoadOptions
from nerf_core.geometry.scene import Scene
from nerf_core.lab.records import Advance, Knob, Report, Result, Row

if TYPE_CHECKING:
    from nerf_core.training.loop import Goal

UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


class Subject(NamedTuple):
    """What a study is about.

    data: the capture or the photo; None: what the program comes with.
    load: how a capture is loaded.
    scene: the loaded capture; None for studies of a photo.
    device: "auto", "cpu", "cuda" or "cuda:N".
    threads: of a CPU for training; 0: all usable cores.
    """

    data: Path | None
    load: LoadOptions
    scene: Scene | None
    device: str = "auto"
    threads: int = 0

    def capture(self) -> Scene:
        """Return the scene of a study that needs one."""
        assert self.scene is not None
        return self.scene


@dataclass
class Bench:
    """Where one row is worked on.

    pictures: a folder for its pictures, which the report reads.
    run: a run folder for its training.
    tick: called between pieces of a training step; see `Method.train`. It must not raise.
    turned: knobs that were turned, by name. The work reads them whenever it likes.
    watched: whether somebody looks at pictures of the work under way.
    """

    pictures: Path
    run: Path
    tick: Callable[[], None] = lambda: None
    turned: dict[str, float] = field(default_factory=dict)
    watched: bool = False


Work = Generator[Advance, None, Result]


class Study(Protocol):
    """A study: a frozen dataclass whose fields are declared with `nerf_core.common.configs.constant`.

    title, summary: for people.
    order: a smaller one is listed first.
    of_scene: whether it is about a capture; else about a photo, unless it has `of_photo` = False.
    """

    title: ClassVar[str]
    summary: ClassVar[str]
    order: ClassVar[int]
    of_scene: ClassVar[bool]

    def plan(self, subject: Subject) -> tuple[Row, ...]:
        """Return what is to be measured. Raises UserError if the options do not fit the subject."""
        ...

    def work(self, subject: Subject, row: Row, bench: Bench) -> Work:
        """Measure one row. Yields after every piece of some 10 ms, and returns what was measured.

        A row that was interrupted is begun again with the same bench and goes on where it can. Raises UserError for
        what makes this row alone impossible; the report then says so.
        """
        ...

    def report(self, subject: Subject, results: Mapping[str, Result], pictures: Path, figures: bool) -> Report:
        """Conclude from the rows that are done.

        Args:
            subject: as it was.
            results: by the keys of rows; {"failed": reason} for one that was impossible.
            pictures: the folder that holds a folder of pictures for each row.
            figures: whether figures are wanted; they take seconds.
        """
        ...


@runtime_checkable
class Turnable(Protocol):
    """A study with numbers that may be turned while it runs."""

    def knobs(self) -> tuple[Knob, ...]:
        """Return them with their values at first."""
        ...


STUDIES: Registry[type[Study]] = Registry("study", "nerf_core.lab.studies")


def checked(study: Any) -> None:
    """Check the fields of a study against their ranges, for its `__post_init__`. Raises UserError with the option."""
    try:
        check_ranges(study)
    except UserError as error:
        raise UserError(re.sub(r"^--set (\w+)=", lambda m: f"--{m[1].replace('_', '-')} ", str(error))) from None


def takes_photo(study: type[Study]) -> bool:
    """Return whether a study is about a photo."""
    return not study.of_scene and getattr(study, "of_photo", True)


def described(study: Any) -> dict[str, Any]:
    """Return a study's options as JSON values."""
    return asdict(study)


def budget(text: str, option: str = "--budget") -> Goal:
    """Return the goal that a text means: "90s", "10m", "1h" of training time, or "200steps".

    Raises UserError for another text.
    """
    from nerf_core.training.loop import Goal

    found = re.fullmatch(r"([0-9.]+) ?(s|m|h|steps)", text.strip())
    try:
        count = float(found[1]) if found else math.nan
    except ValueError:
        count = math.nan
    if found is None or not 0 < count < 1e9:
        raise UserError(f"{option} {shorten(text)}: give a time or a number of steps, such as 90s, 10m, 1h or 200steps")
    if found[2] == "steps":
        if count != int(count):
            raise UserError(f"{option} {shorten(text)}: give a whole number of steps")
        return Goal(int(count))
    return Goal(10**9, count * UNITS[found[2]])


def spelled(text: str) -> str:
    """Return a budget in words: "90 s", "10 min", "1 h", "200 steps"."""
    count, unit = re.fullmatch(r"([0-9.]+) ?(s|m|h|steps)", text.strip()).groups()  # pyright: ignore[reportOptionalMemberAccess]: `budget` has read it
    if unit == "steps":
        return phrases("{n:,} step", "{n:,} steps", round(float(count)))
    spelling = {"s": marked("{count} s"), "m": marked("{count} min"), "h": marked("{count} h")}
    return phrase(spelling[unit], count=digits(count))


def chosen(text: str, names: Iterable[str], option: str) -> tuple[str, ...]:
    """Return the names in a list with commas; "all" for all of them. Raises UserError for an unknown one."""
    known = tuple(names)
    if text == "all":
        return known
    asked = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    wrong = [name for name in asked if name not in known]
    if wrong or not asked:
        which = shorten(wrong[0]) if wrong else "an empty list"
        raise UserError(f"{option} {which}: choose all, or some of {', '.join(known)}, with commas between")
    return asked
