"""Names of files as text, and back."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from odd_names import ODD, SHOWN, needs_bytes

from nerf_core.common.errors import UserError
from nerf_core.common.names import UNPRINTABLE, existing, printable
from nerf_core.live.messages import Notice

ORDINARY = [
    "", "a b.png", "Käsekuchen", "Ночь", "山の写真", "صورة", "תמונה\u200e", "👩\u200d🚀", "🏴\u200d☠️", "e\u0301",
    "C:\\new\\xff", "Screenshot at 10.00\u202fAM", "\u3000全角", "a\\nb", "می\u200cخواهم",
]  # fmt: skip


@pytest.mark.parametrize("name", ORDINARY)
def test_ordinary_names_stay(name: str) -> None:
    assert printable(name) == name
    assert printable(Path(name) / "b") == str(Path(name) / "b")


def test_what_cannot_be_printed_is_escaped() -> None:
    assert printable(ODD) == SHOWN
    assert printable("\t\r\x00\x7f\x9b\u2028\u2067\ud800") == r"\t\r\x00\x7f\u009b\u2028\u2067\ud800"


@given(st.text(st.characters(exclude_categories=()), max_size=20))
def test_any_text_becomes_one_line_of_utf8(text: str) -> None:
    shown = printable(text)
    shown.encode()
    assert shown.splitlines() in ([], [shown])
    assert printable(shown) == shown
    assert (shown == text) == (UNPRINTABLE.search(text) is None)


@needs_bytes
@given(st.binary(min_size=1, max_size=12).filter(lambda name: not set(name) & set(b"\0/")))
def test_json_gives_each_byte_back(name: bytes) -> None:
    """So config.json and checkpoints store paths as they are."""
    text = json.dumps(os.fsdecode(name))
    assert text.isascii()
    assert os.fsencode(json.loads(text)) == name


@needs_bytes
def test_a_shown_path_means_the_file(tmp_path: Path) -> None:
    odd = tmp_path / f"\t{ODD}\r\u0085.png"
    shown = Path(printable(odd))
    assert existing(shown) == shown
    odd.touch()
    assert existing(shown) == existing(odd) == odd
    shown.touch()  # a file with just this name comes first
    assert existing(shown) == shown


def test_messages_are_lines() -> None:
    notice = Notice("error", f"no {ODD}", detail=f"Traceback:\n  {ODD}\u0085".replace("\n\x1b", "\x1b"))
    assert str(UserError(f"no {ODD}")) == notice.text == f"no {SHOWN}"
    assert notice.detail == "Traceback:\n  " + SHOWN.replace(r"\n\x1b", r"\x1b") + r"\u0085"
