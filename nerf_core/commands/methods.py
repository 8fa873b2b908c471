"""`nerf-core methods`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import tyro

from nerf_core.commands import COMMANDS
from nerf_core.common.configs import constants
from nerf_core.common.output import say
from nerf_core.common.signals import Signals
from nerf_core.methods import METHODS


@COMMANDS.register("methods")
@dataclass(frozen=True)
class Methods:
    """List the methods, or the presets and constants of one, which --preset and --set choose."""

    order: ClassVar[int] = 6

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[NAME]", help="A method; none: list them.")] = ""

    def run(self, signals: Signals) -> int:
        if not self.name:
            width = max(map(len, METHODS.names()))
            for name in METHODS.names():
                say(f"{name:{width}}  {METHODS.get(name).summary}")
            return 0
        method = METHODS.get(self.name)
        say(method.summary)
        say(f"presets: {', '.join(('auto', *method.presets))}")
        say("constants, with their defaults; some presets, devices and scenes have others:")
        for name, (default, about) in constants(method.constants).items():
            limits = f" ({about.range})" if about.range else ""
            say(f"  {name} = {default}{limits}")
            say(f"      {about.help}")
        return 0
