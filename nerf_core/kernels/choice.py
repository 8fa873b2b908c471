"""Choose the fastest implementation of the hot loops that can run on a device, and say why a faster one cannot."""

from __future__ import annotations

from typing import ClassVar, Protocol, TypeVar

import torch

from nerf_core.common.language import listed, phrase
from nerf_core.common.registry import Registry
from nerf_core.kernels.packed_kernels import PackedKernels
from nerf_core.kernels.voxel_kernels import VoxelKernels

T_co = TypeVar("T_co", covariant=True)


class Implementation(Protocol[T_co]):
    """An implementation of `VoxelKernels` or `PackedKernels`, described before its libraries are imported.

    devices: types of devices that it runs on ("cpu", "cuda"); empty: all.
    rank: among the implementations that can be used, the one with the lowest rank is taken: the fastest has the lowest.
    summary: what training runs on with it. without: how much slower training is where it cannot be used.
    """

    devices: ClassVar[tuple[str, ...]]
    rank: ClassVar[int]
    summary: ClassVar[str]
    without: ClassVar[str]

    @staticmethod
    def obstacle() -> str:
        """Why it cannot be used on this machine; empty if it can."""
        ...

    @staticmethod
    def make() -> T_co:
        """The kernels. Imports what they need, and compiles them."""
        ...


IMPLEMENTATIONS = "nerf_core.kernels.implementations"
VOXEL_KERNELS: Registry[type[Implementation[VoxelKernels]]] = Registry("voxel kernel", IMPLEMENTATIONS)
PACKED_KERNELS: Registry[type[Implementation[PackedKernels]]] = Registry("packed kernel", IMPLEMENTATIONS)


def voxel_kernels(device: torch.device) -> VoxelKernels:
    """The fastest kernels for a voxel grid that can be used on a device."""
    return _usable(VOXEL_KERNELS, device)[-1].make()


def packed_kernels(device: torch.device) -> PackedKernels:
    """The fastest kernels for packed samples and a hash grid that can be used on a device."""
    return _usable(PACKED_KERNELS, device)[-1].make()


def note(device: torch.device) -> str:
    """Warning to show when a slow fallback is used; empty if the fast implementations are."""
    found: list[str] = []
    for fastest, *rest in (_usable(VOXEL_KERNELS, device), _usable(PACKED_KERNELS, device)):
        if rest:
            text = phrase(
                "{obstacle}: training runs on {instead}, {without}",
                obstacle=fastest.obstacle(),
                instead=phrase(rest[-1].summary),
                without=phrase(fastest.without),
            )
            found.append(text)
    return listed(dict.fromkeys(found), "; ")  # once, if both registries say the same


def _usable(registry: Registry[type[Implementation[T_co]]], device: torch.device) -> list[type[Implementation[T_co]]]:
    """The implementations for a device, fastest first, up to the first one that can be used: the last of the list."""
    known = [registry.get(name) for name in registry.names()]
    ranked = sorted((one for one in known if device.type in (one.devices or (device.type,))), key=lambda i: i.rank)
    first = next(index for index, one in enumerate(ranked) if not one.obstacle())
    return ranked[: first + 1]
