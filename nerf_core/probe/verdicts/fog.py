"""Fog: density that is spread too widely for a surface."""

from __future__ import annotations

from typing import ClassVar

from nerf_core.common.language import marked, phrase
from nerf_core.probe.standing import DEEP, HAZY, Standing, Tone
from nerf_core.probe.verdicts import COUNTS, VERDICTS, Facts

SOLID = 0.5  # the ray is in fog if layers that are not hazy hold less than this share of the weight


@VERDICTS.register(marked("fog"))
class Fog:
    rank: ClassVar[int] = 40
    tone: ClassVar[Tone] = "warning"

    @staticmethod
    def reasons(facts: Facts) -> tuple[str, ...]:
        return _fog_reasons(facts.heavy, facts.thin) if facts.surface is None or facts.thin < SOLID else ()


def _fog_reasons(heavy: list[Standing], share: float) -> tuple[str, ...]:
    if not heavy:
        return (phrase("nothing on the ray makes a pixel: no layer weighs {least:g}", least=COUNTS),)
    thickest = max(heavy, key=lambda s: s.layer.thickness)
    error = "" if thickest.error is None else phrase(", with an error of {error:.3f}", error=thickest.error)
    agreed = ""
    if thickest.error is not None and thickest.most_grains < DEEP:
        agreed = phrase(
            ", or under {deep:.3g} with an error under {error:g}", deep=DEEP * thickest.layer.grain, error=HAZY
        )
    return (
        phrase(
            "only {share:.0%} of what is seen lies in thin layers, or in ones that the photos agree with", share=share
        ),
        phrase(
            "its thickest layer, at {t:.3g}, is {deep:.3g} thick{error}: a surface would be under {most:.3g}{agreed}",
            t=thickest.layer.t,
            deep=thickest.layer.thickness,
            error=error,
            most=thickest.most_grains * thickest.layer.grain,
            agreed=agreed,
        ),
    )
