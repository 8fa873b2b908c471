"""The language of the window: its texts through gettext catalogues, and numbers as that language writes them.

Command lines, their errors, reports and files stay English: only the window's thread chooses another language, and the
worker, which writes files, does not. Texts are looked up when they are drawn, so a change shows in the next frame.
English texts stand in the code and are the keys. A language is one file, assets/languages/CODE.po.

    tr("Start")                                       a text
    tr("{step} of {total}").format(step=…, total=…)   with values: never an f-string, which no catalogue could hold
    trn("{n} photo", "{n} photos", n)                 a plural, with n filled in
    TITLE = marked("Scene")  …  tr(TITLE)             a constant: marked where it stands, looked up where it is drawn
    figure(0.5, ".2f")                                a number in a text

The core makes sentences that are both drawn and written to files: verdicts, notices, names of rows. They are phrases:
texts in English that remember what they are made of, so that `tr` can say them in another language.

    reason = phrase("{share:.0%} of it at {t:.3g}", share=…, t=…)  …  tr(reason)
    phrases("{n:,} photo", "{n:,} photos", n)         a phrase with a plural
"""

from __future__ import annotations

import gettext
import io
import re
import threading
from collections.abc import Iterable
from functools import cache
from numbers import Real
from string import Formatter
from typing import TYPE_CHECKING, Any

from .assets import assets_dir
from .errors import UserError

if TYPE_CHECKING:
    from babel.messages import Catalog

ENGLISH = "en"
NAME = re.compile(r'^"X-Name: (.+)\\n"$', re.MULTILINE)  # in a catalogue's header: what speakers call the language
HEADER_LETTERS = 2000  # a header is shorter
NUMBER = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?")  # as `format` writes it
NUMBERS = re.compile(rf"(?:(?>{NUMBER.pattern})|[-−+±×…–() ,])*+")  # a text without a word


class _Speaker(threading.local):
    """What this thread speaks."""

    language = ENGLISH


_speaker = _Speaker()


@cache
def languages() -> dict[str, str]:
    """Return what speakers call each language, by its code: English, then those that have a catalogue."""
    found = {ENGLISH: "English"}
    for file in sorted((assets_dir() / "languages").glob("*.po")):
        with file.open(encoding="utf-8") as lines:
            name = NAME.search(lines.read(HEADER_LETTERS))
        found[file.stem] = name[1] if name else file.stem
    return found


def use_language(code: str) -> None:
    """Show texts in this language from now on, in this thread. Raises UserError for one without a catalogue."""
    if code not in languages():
        raise UserError(f"--language {code}: choose one of {', '.join(languages())}")
    _catalogue(code)  # reads them now, not in a frame
    _separators(code)
    _speaker.language = code


def language() -> str:
    """Return the code of the language that this thread shows."""
    return _speaker.language


def tr(text: str) -> str:
    """Return a text in the window's language; English where its catalogue has none. An empty one stays empty.

    A text of numbers alone, such as "1,200 × 0.5", gets the language's separators: the worker formats in English.
    """
    if isinstance(text, _Phrase):
        return text.said()
    if _speaker.language == ENGLISH or not text or isinstance(text, _Shown):
        return text
    if NUMBERS.fullmatch(text):
        return NUMBER.sub(lambda found: localized(found[0]), text)
    return _catalogue(_speaker.language).gettext(text)


def said(text: str) -> str:
    """Return a phrase in the window's language, and any other text as it is: it is data, or already said."""
    return text.said() if isinstance(text, _Phrase) else text


def trn(one: str, many: str, n: int) -> str:
    """Return the form of a text that suits the number n, which replaces {n} in it."""
    return _catalogue(_speaker.language).ngettext(one, many, n).format(n=figure(n, ",d"))


def marked(text: str) -> str:
    """Mark a text for the catalogues, and return it in English: `tr` looks it up where it is drawn."""
    return text


def phrase(text: str, **values: object) -> str:
    """Return a sentence with values, in English. `tr` says it in the window's language, where it is drawn.

    Args:
        text: the sentence, with named fields that may have a format specification: "{share:.0%} at {t:.3g}".
        values: by the names of the fields. Numbers get the language's separators, and phrases are said in the language
            too. Other texts stay as they are, for they may be names: wrap a formatted number in `digits`.
    """
    found = _Phrase(text.format(**values))
    found.forms, found.values = (text,), values
    return found


def phrases(one: str, many: str, n: int, **values: object) -> str:
    """Return a phrase whose form suits the number n, which its field {n} may show. See `phrase`."""
    values["n"] = n
    found = _Phrase((one if n == 1 else many).format(**values))
    found.forms, found.values = (one, many), values
    return found


def digits(text: str) -> str:
    """Return a number that Python formatted as a phrase: `tr` shows it with the language's separators."""
    return _Digits(text)


def listed(parts: Iterable[str], between: str = ", ") -> str:
    """Return one phrase of several, with `between` between them."""
    values = {f"part{k}": part for k, part in enumerate(parts)}
    return phrase(between.join(f"{{{name}}}" for name in values), **values)


class _Phrase(str):
    """The English text of a phrase, with its form or its two forms, and with its values. It can be pickled."""

    forms: tuple[str, ...]
    values: dict[str, Any]

    def said(self) -> str:
        """Return it in the window's language."""
        known = _catalogue(_speaker.language)
        one, *many = self.forms
        text = known.ngettext(one, many[0], self.values["n"]) if many else known.gettext(one)
        return _Fields().vformat(text, (), self.values)


class _Digits(_Phrase):
    """The English text of a number."""

    def said(self) -> str:
        return localized(self)


class _Shown(str):
    """A number with the language's separators."""


class _Fields(Formatter):
    """Fills the fields of a phrase in the window's language."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Real):
            return figure(value, format_spec)  # pyright: ignore[reportArgumentType]  numpy's numbers, too
        if isinstance(value, _Phrase):
            return value.said()
        return format(value, format_spec)


def figure(value: float, spec: str = "") -> str:
    """Format a number by Python's format specification, with the language's separators."""
    return localized(format(value, spec))


def localized(digits: str) -> str:
    """Return a number that Python formatted, with the language's separators instead of "," and ".".

    One that has them already stays as it is: its decimal comma must not become a separator of thousands.
    """
    return digits if isinstance(digits, _Shown) else _Shown(digits.translate(_separators(_speaker.language)))


@cache
def _separators(code: str) -> dict[int, str]:
    """The separators of thousands and of decimals of a language, by English ones."""
    if code == ENGLISH:
        return {}
    from babel import Locale

    symbols = Locale.parse(code).number_symbols["latn"]
    return {ord(","): symbols["group"], ord("."): symbols["decimal"]}


@cache
def _catalogue(code: str) -> gettext.NullTranslations:
    """Read a catalogue. It is kept as .po, which people can read and edit, and compiled in memory."""
    if code == ENGLISH:
        return gettext.NullTranslations()
    from babel.messages.pofile import read_po

    with (assets_dir() / "languages" / f"{code}.po").open("rb") as file:
        return _compiled(read_po(file, locale=code))


def _compiled(catalog: Catalog) -> gettext.GNUTranslations:
    from babel.messages.mofile import write_mo

    compiled = io.BytesIO()
    write_mo(compiled, catalog)
    compiled.seek(0)
    return gettext.GNUTranslations(compiled)
