"""Every constant declares its default, range and help in one place."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import pytest

from nerf_core.common.configs import changed, check_changes, check_ranges, constant, constants
from nerf_core.common.errors import UserError
from nerf_core.methods import METHODS


@dataclass(frozen=True)
class Inner:
    size: int = constant(3, "how large", least=1, most=9)


@dataclass(frozen=True)
class Outer:
    share: float = constant(0.5, "how much", share="(0, 1]")
    word: str = constant("a", "which", choices=("a", "b"))
    yes: bool = constant(True, "whether")
    inner: Inner = field(default_factory=Inner)

    def __post_init__(self) -> None:
        check_ranges(self)


def test_nested_constants_have_both_names() -> None:
    found = constants(Outer)
    assert list(found) == ["share", "word", "yes", "inner.size"]
    assert found["inner.size"] == (3, Inner.__dataclass_fields__["size"].metadata["constant"])
    assert [found[name][1].range for name in found] == ["(0, 1]", "a or b", "", "from 1 to 9"]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"share": 0.0}, r"share=0\.0: must lie in \(0, 1\]"),
        ({"share": float("nan")}, "share=nan: must be at least 0"),
        ({"share": float("inf")}, "share=inf: must be a"),
        ({"word": "c"}, "word='c': choose a or b"),
    ],
)
def test_values_outside_of_their_range_are_refused(values: dict[str, object], words: str) -> None:
    with pytest.raises(UserError, match=words):
        Outer(**values)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"share": "0"}, r"--set share=0\.0: must lie in \(0, 1\]"),
        ({"word": "c"}, "--set word='c': choose a or b"),
        ({"inner.size": "0"}, r"--set inner\.size=0: must be at least 1"),
        ({"inner.size": "10"}, r"--set inner\.size=10: must be at most 9"),
        ({"inner.sise": "3"}, r"did you mean inner\.size\?"),
        ({"inner": "3"}, "no such constant"),
    ],
)
def test_changes_are_checked_before_there_is_a_configuration(change: dict[str, str], words: str) -> None:
    with pytest.raises(UserError, match=words):
        check_changes(Outer, change, "made")


@dataclass(frozen=True)
class Odd:
    """Fields whose defaults are of other types than their annotations, and one that no text can change."""

    share: float = constant(1, "how much")
    size: int = constant(None, "how large")
    plain: int = 3
    names: tuple[str, ...] = constant((), "which")


def test_the_annotation_says_what_a_constant_takes() -> None:
    for change in ({"share": "0.5"}, {"size": "4"}, {"plain": "5"}):
        check_changes(Odd, change, "made")
        assert {name: str(getattr(changed(Odd(), change, "made"), name)) for name in change} == change
    for change, words in (({"names": "a"}, "no such constant"), ({"size": "0.5"}, "expected a whole number")):
        with pytest.raises(UserError, match=words):
            check_changes(Odd, change, "made")
        with pytest.raises(UserError, match=words):
            changed(Odd(), change, "made")


@pytest.mark.parametrize("name", METHODS.names())
def test_every_constant_of_a_method_is_described(name: str) -> None:
    kind = METHODS.get(name).constants
    known = constants(kind)
    assert {f.name for f in fields(kind)} == {key.partition(".")[0] for key in known}
    for key, (default, about) in known.items():
        assert 5 < len(about.help) < 130, key
        assert not about.help.endswith("."), key
        if isinstance(default, (int, float)) and not isinstance(default, bool):
            assert about.least <= default <= about.most, key
