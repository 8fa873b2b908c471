"""Tours are read strictly: what is wrong is said with file and line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerf_core.common.errors import UserError
from viewer.tour.conditions import CONDITIONS
from viewer.tour.deeds import DEEDS
from viewer.tour.rich_text import words
from viewer.tour.side_bar import broken
from viewer.tour.steps import Equation, Prose, Question, Task, parse_step, read_tour
from viewer.tour.values import VALUES

PAGE = Path(__file__).parents[3] / "docs" / "tours.md"


def section(name: str) -> str:
    text = PAGE.read_text("utf-8")
    return text.partition(f"<!-- {name} -->")[2].partition(f"<!-- /{name} -->")[0]


def test_the_example_of_the_page_is_a_step() -> None:
    step = parse_step(section("example").partition("```markdown\n")[2].partition("```")[0], "x", "x.md")
    assert step.title == "The highlight"
    assert [type(block) for block in step.blocks] == [Prose, Equation, Task, Question]
    assert step.tasks[0].until is not None
    assert [deed.panel for deed in step.deeds] == ["", "", "", "", "Radiance"]


@pytest.mark.parametrize(
    ("name", "table", "found"),
    [("deeds", DEEDS, r"@(\w+)"), ("conditions", CONDITIONS, r"`(\w+)"), ("values", VALUES, r"\{(\w+)\}")],
)
def test_the_page_lists_everything(name: str, table: dict[str, object], found: str) -> None:
    first_columns = "\n".join(line.split("|")[1] for line in section(name).splitlines() if line.startswith("| `"))
    assert set(re.findall(found, first_columns)) == set(table)


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("no title", 1, "title"),
        ("# A\n\nb\n\n@fly 3", 5, "no such directive"),
        ("# A\n\nb\n@orbit 1", 4, "2 to 3 numbers"),
        ("# A\n\nb\n@orbit 1 95", 4, "elevation"),
        ("# A\n\nb\n@mode red", 4, "choose of"),
        ("# A\n\nb\n@cameras maybe", 4, "on or off"),
        ("# A\n\nb\n@panel Nothing", 4, "choose of"),
        ("# A\n\nb\n@open 1 nan 2", 4, "3 numbers"),
        ("# A\n\nb\n@method nerfs", 4, "choose of"),
        ("# A\n\nb\n@method nerf width", 4, "name=value"),
        ("# A\n\nb\n@method nerf widths=3", 4, "no such constant"),
        ("# A\n\nb\n@study image size=1", 4, "at least 16"),
        ("# A\n\nb\n@do file.save", 4, "choose of camera.frame"),
        ("# A\n\nb\n@equation {sigmas}", 4, "is no value"),
        ("# A\n\nb\n@scene /etc", 4, "without .."),
        ("# A\n\nb\n@scene ../other", 4, "without .."),
        ("# A\n\nb\n@scene //server/share", 4, "without .."),
        ("# A\n\nb\n@scene C:\\photos", 4, "without .."),
        ("# A\n\nb\n@try c\n@until opened near 1 2 3 -1", 5, "greater than 0"),
        ("# A\n\nb\n@until moved", 4, "after @try"),
        ("# A\n\nb\n@try c\n@until never", 5, "choose of"),
        ("# A\n\nb\n@try c\n@until opened near 1 2", 5, "near X Y Z R"),
        ("# A\n\nb\n@answer c", 4, "after @question"),
        ("# A\n\n@question\n\n@answer c", 3, "text after it"),
    ],
)
def test_a_mistake_is_said_with_its_line(text: str, line: int, says: str) -> None:
    with pytest.raises(UserError) as caught:
        parse_step(text, "x", "x.md")
    assert str(caught.value).startswith(f"x.md:{line}: ")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_texts_go_on_over_lines() -> None:
    step = parse_step("# A\nb\nc\n- d\n  e\n- f\n@try g\nh\n@until moved\n@note i\n\nj", "x", "x.md")
    assert [block.text for block in step.blocks if not isinstance(block, Equation)] == [
        "b c", "d e", "f", "g h", "i", "j",
    ]  # fmt: skip


WORDS = [*DEEDS, *CONDITIONS, "equation", "try", "until", "question", "answer", "note", "until opened near", ""]
LINES = st.tuples(
    st.sampled_from([f"@{word} " for word in WORDS] + ["", "- "]), st.text("19-.e{}*`@=naon x\t", max_size=9)
)


@given(st.lists(LINES.map("".join), max_size=9))
@settings(max_examples=150, deadline=None)
def test_any_text_is_a_step_or_one_line_of_error(lines: list[str]) -> None:
    told = ""
    try:
        assert parse_step("\n".join(["# T", *lines]), "x", "x.md").blocks
    except UserError as error:
        told = str(error)
    assert "\n" not in told


def test_folders_that_are_no_tours(tmp_path: Path) -> None:
    for folder, says in ((tmp_path / "none", "is no folder"), (tmp_path, "holds no step")):
        with pytest.raises(UserError, match=says):
            read_tour(folder)
    (tmp_path / "1.md").write_bytes(b"# A\n\xff\xfe")
    with pytest.raises(UserError, match="UTF-8"):
        read_tour(tmp_path)
    (tmp_path / "1.md").write_text("# A\n" + "b" * 200_000)
    with pytest.raises(UserError, match="longer than"):
        read_tour(tmp_path)


def test_words_keep_their_style_and_their_spaces() -> None:
    found = words("A **NeRF**: 3 * 4, *d* and `a * b`.")
    assert [(w.text, w.style) for w in found if w.style] == [
        ("NeRF", "strong"), ("d", "emphasis"), ("a", "code"), ("*", "code"), ("b", "code"),
    ]  # fmt: skip
    assert [w.text for w in found if w.glued] == [":", "."]


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("w = T · α", ["w = T · α"]),
        ("α = 1 − exp(−σ δ) = 1 − exp(−7 · 2) = 1", ["α = 1 − exp(−σ δ)", "  = 1 − exp(−7 · 2)", "  = 1"]),
        ("pixel one, two and three of them", ["pixel one, two and", "  three of them"]),
        ("a" * 30, ["a" * 30]),
    ],
)
def test_an_equation_breaks_before_its_equals_signs(text: str, lines: list[str]) -> None:
    assert broken(text, 20) == lines
