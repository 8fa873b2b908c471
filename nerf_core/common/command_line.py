"""Build command lines from dataclasses, and report each mistake in one line like every other error."""

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
from nerf_core.common.errors import UserError, shorten
from nerf_core.common.output import say
from nerf_core.common.text import closest, suggestion
from nerf_core.common.user_paths import absolute, own_path

CONFIG = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.UseAppendAction,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.DisallowNone,
)
UNREAD = (  # tyro's messages about values that it cannot parse, and the words that replace them
    (r"Could not parse arguments \[(.*)\] into .*\bint\b.*", r"cannot be read: \1: whole numbers are needed"),
    (r"Could not parse arguments \[(.*)\] into .*", r"cannot be read: \1"),
    (r"invalid literal for int\(\) with base 10: (.*)", r"cannot be read: \1: a whole number is needed"),
    (r"could not convert string to float: (.*)", r"cannot be read: \1: a number is needed"),
    (r"Missing value for argument '(.*)'\. Expected 1 values", r"\1: needs a value"),
    (r"Missing value for argument '(.*)'\. Expected (\d+) values", r"\1: needs \2 values"),
    (r"no type matching INT could be instantiated from \[(.*)\]", r"cannot be read: \1: a whole number is needed"),
    (r"no type matching FLOAT could be instantiated from \[(.*)\]", r"cannot be read: \1: a number is needed"),
)


def parse(kind: Any, prog: str, arguments: Sequence[str] | None, description: str | None = None) -> Any:
    """Parse a command line into a dataclass.

    Args:
        kind: the dataclass, or a union of dataclasses for a program with subcommands.
        prog: the program's name in messages.
        arguments: the words to parse; None takes the process's own.
        description: the text at the top of --help; None takes the docstring of `kind`.

    Returns:
        An instance of `kind`, or of one member of the union.

    Raises:
        UserError: names the option that cannot be parsed.
        SystemExit: with status 0 after --help and --version.
    """
    arguments = [_at_home(one) for one in (sys.argv[1:] if arguments is None else arguments)]
    if arguments == ["--version"]:
        say(f"{prog} {__version__}")
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
        command = _command(kind, arguments[0] if arguments else "")
        text = _unknown(command, arguments) or _sentence(said.getvalue())
        whole = prog if command is kind else f"{prog} {arguments[0]}"
        raise UserError(f"{text}; {whole} --help lists the options") from None


def _unknown(kind: Any, arguments: Sequence[str]) -> str:
    """The message about the first word that looks like an option and is none of `kind`; empty if all are known.

    A word with one dash may also be a value: a number such as -inf, or what follows an option that takes one. Only a
    whole option's name without its second dash is taken for a slip, because a file may be called -notes.
    """
    known = {"--help": bool, "--version": bool, **dict(_declared(kind))}
    for before, argument in zip(["", *arguments], arguments, strict=False):
        option = argument.partition("=")[0]
        full = f"--{option.lstrip('-').replace('_', '-')}"
        if not re.match(r"--?[A-Za-z]", option) or option == "-h" or (option.startswith("--") and full in known):
            continue
        if option.startswith("--"):
            near = closest(full[2:], (one[2:] for one in known))  # dashes would count as likeness
        elif _is_number(argument) or _base(known.get(before.replace("_", "-"), bool)) is not bool:
            continue
        else:
            near = full[2:] if full in known else ""
        return f"{option}: no such option{f' (did you mean --{near}?)' if near else ''}"
    return ""


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _command(kind: Any, name: str) -> Any:
    """The member of a union of subcommands that has a name; `kind` itself if none has it."""
    for part in get_args(kind):
        if any(getattr(one, "name", "") == name for one in get_args(part)[1:]):
            return part
    return kind


def _repeatable(kind: Any) -> Iterator[str]:
    """The options that may be given more than once: fields that are lists."""
    for option, declared in _declared(kind):
        if get_origin(_base(declared)) is list:
            yield option


def _base(declared: Any) -> Any:
    """The type of an option without its annotations."""
    return get_args(declared)[0] if get_origin(declared) is Annotated else declared


def _declared(kind: Any) -> Iterator[tuple[str, Any]]:
    """The options of all dataclasses that `kind` contains, with their types."""
    for part in get_args(kind) if get_origin(kind) in (Union, Annotated) else ():
        yield from _declared(part)
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return
    types = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        declared = types[field.name]
        inner = tuple(_declared(declared))
        yield from inner
        if not inner and tyro.conf.Positional not in get_args(declared):
            yield f"--{field.name.replace('_', '-')}", declared


def _at_home(argument: str) -> str:
    """The argument with a leading `~` expanded, because shells do not expand the one in --save=~/x.safetensors.

    A folder that is really called `~` is written ./~. It becomes an absolute path, because Path drops the dot and the
    rest would mean the home folder.
    """
    option, equals, value = argument.partition("=") if argument.startswith("--") else ("", "", argument)
    path = Path(value)
    if not str(path).startswith("~"):
        return argument
    return f"{option}{equals}{own_path(path) if value.startswith('~') else absolute(path)}"


def _sentence(box: str) -> str:
    """The message inside the box that tyro draws: the text between the title and the rule below it.

    The frame consists of Unicode lines, or of dashes where the terminal has no Unicode.
    """
    words: list[str] = []
    for line in box.splitlines()[1:]:
        text = line.strip("│ ")
        if text.strip("─╰╯- "):
            words += text.split()
        elif words:
            break
    text = " ".join(words).partition(" Got errors:")[0].rstrip(".")
    missing = re.match(r"Missing from [^:]*: (--[\w-]+|[A-Z]+) ", text)  # the rest is the option's whole help
    if missing:
        return f"{missing[1]}: is needed"
    wrong = re.match(r"invalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*)\)", text)
    if wrong:
        choices = re.findall(r"'(.*?)'", wrong[3])
        near = suggestion(wrong[1], choices)
        return f"{wrong[2]} {shorten(wrong[1])}{near}: choose from {', '.join(choices)}"
    for theirs, ours in UNREAD:
        text = re.sub(theirs, ours, text)
    return text.removeprefix("Error parsing ")
