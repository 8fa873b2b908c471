"""Commands for the language of the window, one a language, by the name that its speakers give it."""

from __future__ import annotations

from functools import partial

from nerf_core.common.language import languages

from ...model.state import Action, AppState
from ..registry import command


def speak(code: str, state: AppState) -> list[Action]:
    state.language = code
    return []


def spoken(code: str, state: AppState) -> bool:
    return state.language == code


for order, (code, name) in enumerate(languages().items(), 1):
    command(f"language.{code}", name, "Language", order, menu="Language", chosen=partial(spoken, code))(
        partial(speak, code)
    )
