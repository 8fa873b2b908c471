"""The program's own tour: what each step must have, and what both languages must share."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from nerf_core.common.assets import assets_dir
from nerf_core.common.language import languages
from viewer.tour.steps import FIELD, Equation, Prose, Question, read_tour

TOUR = assets_dir() / "tour"
MOST_WORDS = 130  # of a step's paragraphs: a longer text is not read beside a moving picture
NUMBER = re.compile(r"\d+")


def directives(file: Path) -> list[str]:
    """Return the lines of a step that are the same in all languages: what is done and what is waited for."""
    prose = ("@try", "@question", "@answer", "@note", "@equation")
    lines = [line.strip() for line in file.read_text("utf-8").splitlines()]
    return [line for line in lines if line.startswith("@") and not line.startswith(prose)]


@pytest.mark.parametrize("code", languages())
def test_each_step_asks_answers_and_gives_something_to_do(code: str) -> None:
    for step in read_tour(TOUR / code):
        questions = [block for block in step.blocks if isinstance(block, Question)]
        assert questions, step.name
        assert all(question.answer for question in questions), step.name
        assert any(task.until for task in step.tasks), step.name
        assert any(isinstance(block, Equation) for block in step.blocks), step.name
        words = [len(block.text.split()) for block in step.blocks if isinstance(block, Prose) and block.kind != "note"]
        assert sum(words) <= MOST_WORDS, f"{step.name}: {sum(words)} words"


@pytest.mark.parametrize("code", [code for code in languages() if code != "en"])
def test_languages_differ_in_prose_alone(code: str) -> None:
    english = sorted(file.name for file in (TOUR / "en").iterdir())
    assert sorted(file.name for file in (TOUR / code).iterdir()) == english
    for name in english:
        assert directives(TOUR / code / name) == directives(TOUR / "en" / name), name
    for one, other in zip(read_tour(TOUR / "en"), read_tour(TOUR / code), strict=True):
        assert [type(block) for block in one.blocks] == [type(block) for block in other.blocks], one.name
        for a, b in zip(one.blocks, other.blocks, strict=True):
            if isinstance(a, Equation):
                assert FIELD.findall(a.text) == FIELD.findall(b.text), a.text
                assert NUMBER.findall(a.text) == NUMBER.findall(b.text), a.text


def test_the_closing_questions_of_the_lecture_are_asked() -> None:
    """Three questions at the end: the general scheme, positional encoding, a 360° model."""
    last = read_tour(TOUR / "en")[-1]
    asked = [block.text for block in last.blocks if isinstance(block, Question)]
    assert [text[:2] for text in asked] == ["1.", "2.", "3."]
    for text, words in zip(asked, (("in", "out", "trained", "picture"), ("encoding",), ("360°",)), strict=True):
        assert all(word in text for word in words)
