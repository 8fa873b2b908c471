"""Files outside of the repository, used as if they lay in its folders of plug-ins.

As a pytest plug-in (`-p additions`), it adds the files below the folder that the variable ADDITIONS names. It leaves
out tests whose parameter is a plug-in of the program's own, which SHIPPED names: the suite runs them anyway.
"""

from __future__ import annotations

import importlib
import os
import re
from pathlib import Path

import pytest

CONFTEST = Path(__file__).parents[1] / "conftest.py"


def extend(extra: Path) -> None:
    """Let each package find the modules that lie in the folder of its name below `extra`."""
    for folder in sorted({file.parent for file in extra.rglob("*.py")}):
        importlib.import_module(".".join(folder.relative_to(extra).parts)).__path__.append(str(folder))


def pytest_plugin_registered(plugin: object) -> None:
    """Extend the packages after tests/conftest.py was loaded, and before another conftest.py asks a registry."""
    if getattr(plugin, "__file__", None) == str(CONFTEST):
        extend(Path(os.environ["ADDITIONS"]))


def names() -> set[str]:
    """Return the names of all plug-ins of the kinds that docs/extending.md lists."""
    from nerf_core.commands import COMMANDS
    from nerf_core.datasets.capture import DATASETS
    from nerf_core.geometry.paths import PATHS
    from nerf_core.kernels.choice import PACKED_KERNELS, VOXEL_KERNELS
    from nerf_core.lab.study import STUDIES
    from nerf_core.live.shares import SHARES
    from nerf_core.methods import METHODS
    from nerf_core.probe.verdicts import VERDICTS
    from nerf_core.rendering.export.models import EXPORTS
    from nerf_core.rendering.modes import MODES
    from viewer.commands.registry import USER_COMMANDS
    from viewer.ui.contract import PANELS

    kinds = (
        COMMANDS, DATASETS, PATHS, PACKED_KERNELS, VOXEL_KERNELS, STUDIES, SHARES, METHODS, VERDICTS, EXPORTS, MODES,
        USER_COMMANDS, PANELS,
    )  # fmt: skip
    return {name for kind in kinds for name in kind.names()}


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    shipped = set(os.environ["SHIPPED"].split("|"))
    known = names()
    longest_first = "|".join(map(re.escape, sorted(known, key=len, reverse=True)))
    kept, left_out = [], []
    for item in items:
        parameters = item.name.partition("[")[2].rstrip("]")
        about = set(re.findall(rf"(?<![^-])(?:{longest_first})(?![^-])", parameters))
        (left_out if about and about <= shipped else kept).append(item)
    config.hook.pytest_deselected(items=left_out)
    items[:] = kept
