"""Choose a scene that a method takes, for tests of all methods."""

from __future__ import annotations

import pytest
import torch

from nerf_core.common.errors import UserError
from nerf_core.geometry.scene import Scene
from nerf_core.methods import METHODS


def fitting(request: pytest.FixtureRequest, *scenes: Scene) -> Scene:
    """Return the first of some scenes that the test's method can be configured for; the first one without a method.

    request: that of a fixture. The test's parameter "make" or "name" is the method's name.
    """
    params = request.node.callspec.params if hasattr(request.node, "callspec") else {}
    name = str(params.get("make", params.get("name", "")))
    for scene in scenes if name in METHODS.names() else ():
        try:
            METHODS.get(name).configure(scene, "auto", {}, torch.device("cpu"))
            return scene
        except UserError:
            continue
    return scenes[0]
