"""Languages: catalogues that hold what the code shows, plurals and numbers."""

from __future__ import annotations

import gettext
import io
import threading
from collections.abc import Iterator
from pathlib import Path

import make_catalogue
import pytest
from babel.messages import Catalog
from babel.messages.pofile import read_po

from nerf_core.common import language
from nerf_core.common.errors import UserError
from nerf_core.common.language import ENGLISH, figure, languages, phrases, tr, trn, use_language
from nerf_core.common.text import duration, number, size

FORMS = {"{n} photo": ["{n} фотография", "{n} фотографии", "{n} фотографий"], "step {step}": "шаг {step}"}


@pytest.fixture(autouse=True)
def english() -> Iterator[None]:
    yield
    use_language(ENGLISH)


@pytest.fixture
def russian(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small Russian catalogue, with the plural rule of the real one."""
    header = make_catalogue.header("ru")
    catalog = read_po(io.BytesIO(header.encode()), locale="ru")
    catalog.add(("{n} photo", "{n} photos"), FORMS["{n} photo"])
    catalog.add("step {step}", FORMS["step {step}"])
    compiled = language._compiled(catalog)
    monkeypatch.setattr(language, "_catalogue", lambda code: compiled if code == "ru" else gettext.NullTranslations())
    use_language("ru")


@pytest.mark.usefixtures("russian")
def test_a_plural_has_the_form_of_its_number() -> None:
    numbers = {1: "1 фотография", 21: "21 фотография", 2: "2 фотографии", 104: "104 фотографии", 0: "0 фотографий"}
    numbers |= {11: "11 фотографий", 14: "14 фотографий", 1_000_111: "1\xa0000\xa0111 фотографий"}
    for n, text in numbers.items():
        assert trn("{n} photo", "{n} photos", n) == text
        assert tr(phrases("{n:,} photo", "{n:,} photos", n)) == (f"{n:,} photo{'s' * (n != 1)}".replace(",", "\xa0"))


@pytest.mark.usefixtures("russian")
def test_numbers_are_as_the_language_writes_them() -> None:
    assert figure(1234567.5, ",.1f") == "1\xa0234\xa0567,5"
    assert tr(number(-0.25)) == "−0,25"
    assert tr("step {step}").format(step=figure(12400, ",")) == "шаг 12\xa0400"
    assert (tr(duration(0.44)), tr(size(1.234e9))) == ("0,4 s", "1,23 GB")  # units that have no translation here
    assert (number(-0.25), duration(0.44)) == ("−0.25", "0.4 s")  # as in a file


@pytest.mark.usefixtures("russian")
def test_another_thread_speaks_english() -> None:
    """The worker writes files."""
    found: list[str] = []
    thread = threading.Thread(target=lambda: found.extend((tr("step {step}"), figure(0.5))))
    thread.start()
    thread.join()
    assert found == ["step {step}", "0.5"]
    assert tr("step {step}") == "шаг {step}"


def test_a_language_without_a_catalogue_is_refused() -> None:
    assert list(languages().items())[:1] == [("en", "English")]
    assert languages()["ru"] == "Русский"
    with pytest.raises(UserError, match="--language xx: choose one of en, ru"):
        use_language("xx")


SOURCE = """
tr("one")
tr(
    "two "
    "parts {n}"
).format(n=tr("inner"))
trn("{n} ray", "{n} rays", count)
title = marked("Scene")
language.phrase("at {t:.3g}", t=t)
tr(NAMES["other"]), tr(variable), phrases(one, many, 1), other("no")
"""


def test_texts_are_found_in_calls() -> None:
    found = {"one", "two parts {n}", "inner", "Scene", "at {t:.3g}"}
    assert set(make_catalogue.texts(SOURCE, "a.py")) == {("{n} ray", "{n} rays"), *((text,) for text in found)}


@pytest.mark.parametrize("call", ['tr(f"{n} rays")', 'tr("a" + b)', 'tr("a" if b else "c")', 'trn("a", b, 1)'])
def test_a_text_that_is_put_together_is_refused(call: str) -> None:
    with pytest.raises(SystemExit, match=r"a\.py:2: .* takes whole texts"):
        list(make_catalogue.texts(f"\n{call}", "a.py"))


def test_an_update_keeps_translations_and_drops_what_is_no_longer_shown() -> None:
    template = Catalog()
    template.add("kept", locations=[("b.py", 7)])
    template.add("new", locations=[("a.py", 3)])
    old = make_catalogue.header("ru") + '\nmsgid "kept"\nmsgstr "остаётся"\n\nmsgid "gone"\nmsgstr "ушло"\n'
    new = make_catalogue.updated(old, "ru", template)
    assert new.startswith(make_catalogue.header("ru"))
    assert new.endswith('\n#: b.py\nmsgid "kept"\nmsgstr "остаётся"\n\n#: a.py\nmsgid "new"\nmsgstr ""\n')
    assert "gone" not in new
    assert make_catalogue.updated(new, "ru", template) == new


def test_a_catalogue_keeps_its_header(monkeypatch: pytest.MonkeyPatch) -> None:
    """Versions of Babel write one rule of plurals differently, and the file would be out of date with some of them."""
    template = make_catalogue.Catalog()
    template.add(("{n} ray", "{n} rays"), locations=[("a.py", 3)])
    old = make_catalogue.updated(make_catalogue.header("ru"), "ru", template)
    monkeypatch.setattr(make_catalogue, "get_plural", lambda code: "nplurals=2; plural=(n != 1);")
    assert make_catalogue.header("ru") not in old
    assert make_catalogue.updated(old, "ru", template) == old


CATALOGUES = sorted(make_catalogue.FOLDER.glob("*.po"))


@pytest.mark.parametrize("file", CATALOGUES, ids=lambda file: file.stem)
def test_a_translation_has_the_fields_of_its_text(file: Path) -> None:
    """With their formats, so that no value is lost and none is asked for that there is not."""
    catalog = read_po(io.BytesIO(file.read_bytes()), locale=file.stem)
    assert [str(one) for one in catalog if one.id and list(one.check(catalog))] == []
    done = [(text, said) for text, said in make_catalogue.pairs(catalog) if said]
    wrong = [text for text, said in done if _fields(text) != _fields(said)]
    assert wrong == []


def _fields(text: str) -> set[tuple[str, str]]:
    parts = language._Fields().parse(text)
    return {(name, spec or "") for _, name, spec, _ in parts if name is not None}


@pytest.mark.parametrize("file", CATALOGUES, ids=lambda file: file.stem)
def test_a_catalogue_has_every_text_and_its_translation(file: Path) -> None:
    text = file.read_text("utf-8")
    assert text == make_catalogue.updated(text, file.stem, make_catalogue.extracted()), make_catalogue.__doc__
    catalog = read_po(io.BytesIO(text.encode()), locale=file.stem)
    assert [one.id for one in catalog if one.fuzzy and one.id] == []
    assert make_catalogue.untranslated(catalog) == []
