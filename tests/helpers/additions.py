"""Files outside of the repository, used as if they lay in its folders of plug-ins.

As a pytest plug-in (`-p additions`), it adds the files below the folder that the variable ADDITIONS names.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path

CONFTEST = Path(__file__).parents[1] / "conftest.py"


def extend(extra: Path) -> None:
    """Let each package find the modules that lie in the folder of its name below `extra`."""
    for folder in sorted({file.parent for file in extra.rglob("*.py")}):
        importlib.import_module(".".join(folder.relative_to(extra).parts)).__path__.append(str(folder))


def pytest_plugin_registered(plugin: object) -> None:
    """Extend the packages after tests/conftest.py was loaded, and before another conftest.py asks a registry."""
    if getattr(plugin, "__file__", None) == str(CONFTEST):
        extend(Path(os.environ["ADDITIONS"]))
