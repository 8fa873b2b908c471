"""Command lines from dataclasses; a mistake in one is a single line, like every other error."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro

from nerf_core import __version__
from nerf_core.common.errors import UserError
from nerf_core.common.user_paths import own_path

CONFIG = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.UseAppendAction,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.DisallowNone,
)
UNREAD = (  # what tyro says of values, and what is said of them here
    (r"Could not parse arguments \[(.*)\] into .*\bint\b.*", r"cannot be read: \1: whole numbers are needed"),
    (r"Could not parse arguments \[(.*)\] into .*", r"cannot be read: \1"),
    (r"no type matching INT could be instantiated from \[(.*)\]", r"cannot be read: \1: a whole number is needed"),
    (r"no type matching FLOAT could be instantiated from \[(.*)\]", r"cannot be read: \1: a number is needed"),
)


def parse(kind: Any, prog: str, arguments: Sequence[str] | None, description: str | None = None) -> Any:
    """An instance of the dataclass (or of one of a union's) that `arguments` (None: the process's own) describe.

    description: what --help says of the program; by default the docstring of `kind`.
    Raises UserError naming what cannot be taken, SystemExit(0) after --help and --version.
    """
    arguments = [_at_home(one) for one in (sys.argv[1:] if arguments is None else arguments)]
    if arguments == ["--version"]:
        print(f"{prog} {__version__}")
        raise SystemExit(0)
    options = [a.partition("=")[0].replace("_", "-") for a in arguments if a.startswith("--")]
    repeatable = set(_repeatable(kind))
    for option in options:
        if options.count(option) > 1 and option not in repeatable:
            raise UserError(f"{option}: given {options.count(option)} times; once is enough")
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(kind, prog=prog, description=description, args=arguments, config=CONFIG)
    except SystemExit as end:
        if not end.code:
            raise
        text = _sentence(said.getvalue())
        whole = (
            f"{prog} {arguments[0]}"
            if get_args(kind) and arguments and arguments[0].replace("-", "").isalpha() and "--" in text
            else prog
        )
        raise UserError(f"{text}; {whole} --help lists the options") from None


def _repeatable(kind: Any) -> Iterator[str]:
    """The options of a dataclass, of those in its fields and of all in a union that may be given more than once."""
    for part in get_args(kind) if get_origin(kind) in (Union, Annotated) else ():
        yield from _repeatable(part)
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return
    types = get_type_hints(kind)
    for field in fields(kind):
        if get_origin(types[field.name]) is list:
            yield f"--{field.name.replace('_', '-')}"
        yield from _repeatable(types[field.name])


def _at_home(argument: str) -> str:
    """The same with a `~` at its beginning put into full: shells leave the one in --save=~/x.ckpt as it is. A folder of
    that name, ./~, is told by its whole path: paths drop the dot, and would mean the home folder from then on."""
    option, equals, value = argument.partition("=") if argument.startswith("--") else ("", "", argument)
    path = Path(value)
    if not str(path).startswith("~"):
        return argument
    return f"{option}{equals}{own_path(path) if value.startswith('~') else path.absolute()}"


def _sentence(box: str) -> str:
    """The message in a box: what stands between its title and the rule below, without the frame.

    It is drawn with Unicode's lines or, where the terminal has none, with dashes.
    """
    words: list[str] = []
    for line in box.splitlines()[1:]:
        text = line.strip("│ ")
        if text.strip("─╰╯- "):
            words += text.split()
        elif words:
            break
    text = " ".join(words).partition(" Got errors:")[0].rstrip(".")
    missing = re.match(r"Missing from [^:]*: (--[\w-]+) ", text)  # what follows is the option's whole help
    if missing:
        return f"{missing[1]}: is needed"
    for theirs, ours in UNREAD:
        text = re.sub(theirs, ours, text)
    return text.removeprefix("Error parsing ")
