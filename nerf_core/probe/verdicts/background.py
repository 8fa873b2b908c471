"""Background: the ray hits nothing."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked, phrase
from nerf_core.probe.standing import Tone
from nerf_core.probe.verdicts import NOTHING, VERDICTS, Facts


@VERDICTS.register(marked("background"))
class Background:
    rank: ClassVar[int] = 0
    tone: ClassVar[Tone] = "good"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        if facts.ray.opacity >= NOTHING:
            return ()
        return (phrase("the ray met nothing: its opacity is {opacity:.3f}", opacity=facts.ray.opacity),)
