"""The language of the window: its texts through gettext catalogues, and numbers as that language writes them.

Command lines, their errors, reports and files stay English: only the window chooses another language. Texts are looked
up when they are drawn, so a change shows in the next frame. English texts stand in the code and are the keys.

    tr("Start")                                       a text
    tr("{step} of {total}").format(step=…, total=…)   with values: never an f-string, which no catalogue could hold
    trn("{n} photo", "{n} photos", n)                 a plural, with n filled in
    TITLE = marked("Scene")  …  tr(TITLE)             a constant: marked where it stands, looked up where it is drawn
    figure(0.5, ".2f")                                a number in a text
"""

from __future__ import annotations

import gettext
import io
from functools import cache

from .assets import assets_dir
from .errors import UserError

ENGLISH = "en"
LANGUAGES = {ENGLISH: "English", "ru": "Русский"}  # by code: what speakers call it
SEPARATORS = {"ru": {",": "\u202f", ".": ","}}  # of thousands (a narrow space that does not break), of decimals

_language = ENGLISH


def use_language(code: str) -> None:
    """Show texts in this language from now on, in all threads. Raises UserError for one without a catalogue."""
    global _language  # noqa: PLW0603  a process has one window
    if code not in LANGUAGES:
        raise UserError(f"--language {code}: choose one of {', '.join(LANGUAGES)}")
    _catalogue(code)  # reads it now, not in a frame
    _language = code


def language() -> str:
    """Return the code of the language that is shown."""
    return _language


def tr(text: str) -> str:
    """Return a text in the window's language; English where its catalogue has none. An empty one stays empty."""
    return _catalogue(_language).gettext(text) if text else ""


def trn(one: str, many: str, n: int) -> str:
    """Return the form of a text that suits the number n, which replaces {n} in it."""
    return _catalogue(_language).ngettext(one, many, n).format(n=figure(n, ",d"))


def marked(text: str) -> str:
    """Mark a text for the catalogues, and return it in English: `tr` looks it up where it is drawn."""
    return text


def figure(value: float, spec: str = "") -> str:
    """Format a number by Python's format specification, with the language's separators."""
    return localized(format(value, spec))


def localized(digits: str) -> str:
    """Return a number that Python formatted, with the language's separators instead of "," and "."."""
    separators = SEPARATORS.get(_language)
    return digits.translate(str.maketrans(separators)) if separators else digits


@cache
def _catalogue(code: str) -> gettext.NullTranslations:
    """Read a catalogue. It is kept as .po, which people can read and edit, and compiled in memory."""
    if code == ENGLISH:
        return gettext.NullTranslations()
    from babel.messages.mofile import write_mo
    from babel.messages.pofile import read_po

    compiled = io.BytesIO()
    with (assets_dir() / "languages" / f"{code}.po").open("rb") as file:
        write_mo(compiled, read_po(file, locale=code))
    compiled.seek(0)
    return gettext.GNUTranslations(compiled)
