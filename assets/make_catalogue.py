"""Bring the catalogues of assets/languages up to date with the texts in the code.

    python assets/make_catalogue.py           # update every catalogue; translations are kept
    python assets/make_catalogue.py de        # begin a new language
    python assets/make_catalogue.py --check   # write nothing; fail if a catalogue is not up to date

Untranslated texts are then those with an empty `msgstr`. A text that nobody shows any more is dropped.
"""

from __future__ import annotations

import ast
import io
import sys
from collections.abc import Iterator
from pathlib import Path

from babel import Locale
from babel.messages import Catalog
from babel.messages.plurals import get_plural
from babel.messages.pofile import read_po, write_po

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "assets" / "languages"
PACKAGES = "nerf_core", "viewer"
TEXTS = {"tr": 1, "marked": 1, "phrase": 1, "trn": 2, "phrases": 2}  # arguments that are texts, by the function
MADE = ast.JoinedStr | ast.BinOp | ast.BoolOp | ast.IfExp  # from literals, perhaps, which no catalogue could hold
WIDTH = 110  # letters of a line
HEADER = """msgid ""
msgstr ""
"Project-Id-Version: nerf-viewer\\n"
"Language: {code}\\n"
"X-Name: {name}\\n"
"MIME-Version: 1.0\\n"
"Content-Type: text/plain; charset=utf-8\\n"
"Content-Transfer-Encoding: 8bit\\n"
"Plural-Forms: {plural}\\n"
"""


def texts(source: str, file: str) -> Iterator[tuple[str, ...]]:
    """Yield the texts in the calls of `tr`, `trn`, `marked`, `phrase` and `phrases`: one, or two of a plural.

    A call with a variable has no text. Raises SystemExit for a text that is put together in the call.
    """
    for node in ast.walk(ast.parse(source, file)):
        if not isinstance(node, ast.Call):
            continue
        name = getattr(node.func, "id", getattr(node.func, "attr", ""))
        wanted = node.args[: TEXTS.get(name, 0)]
        found = tuple(one.value for one in wanted if isinstance(one, ast.Constant) and isinstance(one.value, str))
        made = any(isinstance(one, MADE) and _has_literal(one) for one in wanted)
        if made or (found and len(found) != TEXTS[name]):
            raise SystemExit(f"{file}:{node.lineno}: {name}() takes whole texts: put values into it with .format()")
        if found and all(found):
            yield found


def _has_literal(made: ast.expr) -> bool:
    return any(isinstance(part, ast.Constant) and isinstance(part.value, str) for part in ast.iter_child_nodes(made))


def extracted() -> Catalog:
    """Return a catalogue of all texts in the code, without translations."""
    found = Catalog()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            file = path.relative_to(ROOT).as_posix()
            for text in texts(path.read_text("utf-8"), file):
                found.add(text if len(text) > 1 else "".join(text), locations=[(file, 0)])
    return found


def updated(text: str, code: str, template: Catalog) -> str:
    """Return a catalogue's file with the texts of the template, and with the translations that it has of them.

    text: the file as it is, whose header stays: another version of Babel may write the same rule of plurals otherwise.
    code: the language.
    """
    catalog = read_po(io.BytesIO(text.encode()), locale=code)
    catalog.update(template, no_fuzzy_matching=True)
    for message in catalog:
        message.flags -= {"python-format", "python-brace-format"}  # babel guesses them from signs like "%"
    body = io.BytesIO()
    write_po(body, catalog, WIDTH, omit_header=True, sort_output=True, ignore_obsolete=True, include_lineno=False)
    head = text.split("\n\n", 1)[0].rstrip("\n")
    return f"{head}\n\n{body.getvalue().decode().strip()}\n"


def pairs(catalog: Catalog) -> Iterator[tuple[str, str]]:
    """Yield every text with its translation, which may be empty, and every form of a plural with the text of many."""
    for message in catalog:
        text = message.id if isinstance(message.id, str) else message.id[-1]
        forms = (message.string,) if isinstance(message.string, str | None) else message.string
        if text:
            yield from ((text, form or "") for form in forms)


def untranslated(catalog: Catalog) -> list[str]:
    """Return the texts that have no translation, or not all forms of a plural."""
    return sorted({text for text, translation in pairs(catalog) if not translation})


def header(code: str) -> str:
    """Return a catalogue without texts."""
    name = Locale.parse(code).display_name or code
    return HEADER.format(code=code, name=name[:1].upper() + name[1:], plural=get_plural(code))


def main(arguments: list[str]) -> int:
    """Return the exit status."""
    check, codes = "--check" in arguments, [word for word in arguments if not word.startswith("-")]
    template, stale = extracted(), 0
    for file in sorted({*FOLDER.glob("*.po"), *(FOLDER / f"{code}.po" for code in codes)}):
        old = file.read_text("utf-8") if file.exists() else header(file.stem)
        new = updated(old, file.stem, template)
        if check and new != old:
            print(f"{file.name}: not up to date: run python assets/make_catalogue.py", file=sys.stderr)
            stale += 1
        elif not check:
            file.write_text(new, "utf-8")
            catalog = read_po(io.BytesIO(new.encode()), locale=file.stem)
            missing = len(untranslated(catalog))
            print(f"{file.name}: {len(catalog)} texts, {missing} without a translation")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
