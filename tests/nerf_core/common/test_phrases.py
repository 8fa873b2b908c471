"""Phrases are English texts that `tr` says in another language."""

from __future__ import annotations

import gettext
import pickle

import pytest

from nerf_core.common import language
from nerf_core.common.language import digits, figure, listed, localized, phrase, phrases, tr

TEXTS = {"{share:.0%} at {t:.3g}, {why}": "{why}: {t:.3g}, {share:.0%}", "of {name}": "у {name}", "train": "учёба"}


class Catalogue(gettext.NullTranslations):
    """A few texts, and the plural of photos."""

    def gettext(self, message: str) -> str:
        return TEXTS.get(message, message)

    def ngettext(self, msgid1: str, msgid2: str, n: int) -> str:
        return "{n:,} фото"


def test_a_phrase_is_english_until_it_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    inner = phrase("of {name}", name="train")
    votes = phrases("{n:,} photo", "{n:,} photos", 1200)
    whole = phrase("{share:.0%} at {t:.3g}, {why}", share=0.25, t=1.5, why=listed((inner, votes), "; "))
    whole = pickle.loads(pickle.dumps(whole))  # as a message between processes
    assert whole == tr(whole) == "25% at 1.5, of train; 1,200 photos"
    monkeypatch.setattr(language, "_catalogue", lambda _: Catalogue())
    monkeypatch.setattr(language._speaker, "language", "ru")
    assert tr(whole) == "у train; 1\xa0200 фото: 1,5, 25%"  # a name is not translated
    assert whole == "25% at 1.5, of train; 1,200 photos"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("−0.125 0.500", "−0,125 0,500"),
        ("1,200, 34", "1\xa0200, 34"),  # column and row
        ("27.31 ± 0.20", "27,31 ± 0,20"),
        ("(64, 128)", "(64, 128)"),
        ("v1.5", "v1.5"),
    ],
)
def test_numbers_of_the_worker_get_the_separators(text: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert tr(text) == text
    monkeypatch.setattr(language, "_catalogue", lambda _: Catalogue())
    monkeypatch.setattr(language._speaker, "language", "ru")
    assert tr(text) == said


def test_a_name_of_digits_is_not_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language, "_catalogue", lambda _: Catalogue())
    monkeypatch.setattr(language._speaker, "language", "ru")
    assert tr(phrase("of {name}", name="2024.10")) == "у 2024.10"  # a folder, say
    assert tr(phrase("of {name}", name=digits("1,024.5"))) == "у 1\xa0024,5"


def test_a_number_that_is_said_already_is_not_said_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language._speaker, "language", "ru")
    assert figure(0.362, ".3f") == localized(figure(0.362, ".3f")) == tr(figure(0.362, ".3f")) == "0,362"
    assert localized("1,000.5") == "1\xa0000,5"
