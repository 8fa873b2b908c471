"""A CUDA device that is only pretended, for machines without one: its rules, not its arithmetic and not its speed.

A `FarTensor` says that it lies on cuda:0, keeps its numbers in memory, and refuses what CUDA refuses: operands that lie
elsewhere, numpy, generators of the other device, and, while a graph is recorded, whatever would wait for the device.
A recorded graph is replayed operation by operation on the tensors it was recorded with.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any, ClassVar
from unittest import mock

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map

optimizer = importlib.import_module("torch.optim.optimizer")
CUDA = torch.device("cuda", 0)
WAITS = {
    "_local_scalar_dense", "nonzero", "masked_select", "bincount", "repeat_interleave", "equal", "_unique", "_unique2",
    "unique_dim", "unique_consecutive",
}  # fmt: skip
INDEXES = {"index", "index_put", "index_put_", "_index_put_impl_"}
NO_NUMPY = "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory first."


def is_far(device: object) -> bool:
    """Whether an argument called `device` means the pretended one."""
    return device is not None and torch.device(device).type == "cuda"  # pyright: ignore[reportCallIssue, reportArgumentType]


class Graph:
    """What `torch.cuda.CUDAGraph` is: operations on tensors that stay where they are."""

    recording: ClassVar[Graph | None] = None

    def __init__(self) -> None:
        self.operations: list[tuple[Callable[..., Any], Any, Any, Any]] = []
        self._ran = True  # recording has, which a GPU's has not

    def replay(self) -> None:
        if self._ran:
            self._ran = False
            return
        for operation, args, kwargs, given in self.operations:
            now, before = (tree_flatten(v)[0] for v in (operation(*args, **kwargs), given))
            for old, new in zip(before, now, strict=True):
                if isinstance(old, Tensor) and old.untyped_storage().data_ptr() != new.untyped_storage().data_ptr():
                    old.copy_(new)


@contextmanager
def recorded(graph: Graph) -> Iterator[None]:
    Graph.recording = graph
    try:
        yield
    finally:
        Graph.recording = None


def wait(what: str) -> None:
    """The device's queue must be empty for this."""
    if Graph.recording is not None:
        raise RuntimeError(f"operation not permitted when stream is capturing: {what}")


class FarTensor(Tensor):
    """See the module. here: the numbers."""

    here: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore[reportAssignmentType]

    @staticmethod
    def __new__(cls, here: Tensor, requires_grad: bool = False) -> FarTensor:
        made = Tensor._make_wrapper_subclass(  # what is below Python takes it for a CPU's: that is where it can run
            cls, here.shape, strides=here.stride(), storage_offset=here.storage_offset(), dtype=here.dtype,
            device=torch.device("cpu"), requires_grad=requires_grad,
        )  # fmt: skip
        made.here = here
        return made

    @property
    def is_cuda(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return True

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return CUDA

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError(NO_NUMPY)

    def __array__(self, *_: object, **__: object) -> Any:
        raise TypeError(NO_NUMPY)

    def tolist(self) -> list[Any]:
        return moved(self, "cpu").tolist()

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"FarTensor({self.here!r})"

    def __deepcopy__(self, memo: dict[int, Any]) -> FarTensor:
        new = FarTensor(self.here.detach().clone(), self.requires_grad)
        if isinstance(self, nn.Parameter):
            new._is_param = True  # pyright: ignore[reportAttributeAccessIssue]  how torch knows a parameter of another class
        memo[id(self)] = new
        return new

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Mapping[str, Any] | None = None) -> Any:
        kwargs, name = dict(kwargs or {}), func.overloadpacket.__name__
        tensors = [v for v in tree_flatten((args, kwargs))[0] if isinstance(v, Tensor)]
        near = [v for v in tensors if not isinstance(v, FarTensor)]
        if name in WAITS:
            wait(name)
        if name in INDEXES:
            indices = [v for v in args[1] if v is not None]
            if any(v.dtype == torch.bool or not isinstance(v, FarTensor) for v in indices):
                wait("an index that is a mask, or on the CPU")
            near = [v for v in near if not any(v is index for index in indices)]  # CUDA takes those
        if name == "copy_" and near:
            wait("a copy between devices")
            args[0].copy_(args[1].here) if isinstance(args[1], FarTensor) else args[0].here.copy_(args[1])
            return args[0]
        if any(v.dim() for v in near):  # a single number may lie anywhere
            raise RuntimeError(f"Expected all tensors to be on the same device, but found cuda:0 and cpu ({func})")
        if "device" in kwargs:
            kwargs["device"] = torch.device("cpu")
        given = tree_map(lambda v: v.here if isinstance(v, FarTensor) else v, (args, kwargs))
        result = func(*given[0], **given[1])
        if Graph.recording is not None:
            Graph.recording.operations.append((func, *given, result))
        if name == "_local_scalar_dense":
            return result
        far = tree_map(lambda v: FarTensor(v) if isinstance(v, Tensor) else v, result)
        return return_and_correct_aliasing(func, args, kwargs, far)


class _ToFar(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, near: Tensor) -> Tensor:
        return FarTensor(near.detach().clone())

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        return gradients[0].here


class _ToNear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, far: FarTensor) -> Tensor:
        return far.here.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        return FarTensor(gradients[0])


def moved(tensor: Tensor, device: object) -> Any:
    """The tensor there; a copy, where it is not there yet."""
    if is_far(device) == isinstance(tensor, FarTensor):
        return tensor
    wait("a copy between devices")
    return (_ToFar if is_far(device) else _ToNear).apply(tensor)


class Generator(torch.Generator):
    """State of a CUDA generator: 16 bytes, which lie on the CPU."""

    states: ClassVar[dict[bytes, Tensor]] = {}
    far: bool

    def __new__(cls, device: object = "cpu") -> Generator:
        made = super().__new__(cls, torch.device("cpu"))  # pyright: ignore[reportCallIssue]
        made.far = is_far(device)
        return made

    def get_state(self) -> Tensor:
        state = super().get_state()
        if not self.far:
            return state
        digest = hashlib.md5(state.numpy().tobytes()).digest()
        self.states[digest] = state
        return torch.tensor(list(digest), dtype=torch.uint8)

    def set_state(self, new_state: Tensor) -> torch.Generator:
        if isinstance(new_state, FarTensor):
            raise TypeError("RNG state must be a torch.ByteTensor")
        if self.far and len(new_state) != 16:
            raise RuntimeError("RNG state is wrong size")
        return super().set_state(self.states[bytes(new_state.tolist())] if self.far else new_state)


class Rules(TorchFunctionMode):
    """What is decided before a call reaches a device. Of the thread that enters it, as every such mode."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Mapping[str, Any] | None = None) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", "")
        own = args[0] if args and isinstance(args[0], Tensor) else None
        far = isinstance(own, FarTensor)
        if func is Tensor.to:
            return _to(*args, **kwargs)
        if func is Tensor.cpu:
            return moved(args[0], "cpu")
        wanted = kwargs.get("device")
        generator = kwargs.get("generator")
        if generator is not None and generator.far != (is_far(wanted) if wanted is not None else far):
            raise RuntimeError(f"Expected a generator of the tensor's device ({name})")
        if wanted is None:
            return func(*args, **kwargs)
        if is_far(wanted) and name in ("tensor", "as_tensor"):
            wait("a copy between devices")
        kwargs["device"] = torch.device("cpu")
        if isinstance(own, FarTensor):
            args = own.here, *args[1:]
        made = func(*args, **kwargs)
        return FarTensor(made) if is_far(wanted) else made


def _to(tensor: Tensor, *args: Any, **kwargs: Any) -> Any:
    if args and isinstance(args[0], Tensor):
        args = args[0].device, args[0].dtype
    dtype, device = kwargs.get("dtype"), kwargs.get("device")
    for arg in args:
        if isinstance(arg, torch.dtype):
            dtype = arg
        elif isinstance(arg, str | torch.device):
            device = arg
    there = tensor if device is None else moved(tensor, device)
    there = there if dtype is None else Tensor.to(there, dtype)
    return there.clone() if there is tensor and kwargs.get("copy") else there


def _module_to(module: nn.Module, device: object) -> nn.Module:
    for part in module.modules():
        for parameter in part.parameters(recurse=False):
            torch.utils.swap_tensors(parameter, nn.Parameter(moved(parameter.detach(), device)))
    return module


class _Stream:
    """There is one queue."""

    def __init__(self, *_: object) -> None: ...

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...

    def wait_stream(self, _: object) -> None: ...

    def is_capturing(self) -> bool:
        return Graph.recording is not None


class Launches:
    """A module of Triton kernels, interpreted: they see what far tensors hold, and are recorded as one operation."""

    def __init__(self, kernels: ModuleType) -> None:
        self._kernels = kernels

    def __getattr__(self, name: str) -> Any:
        kernel = getattr(self._kernels, name)

        class Grids:
            def __getitem__(self, grid: Any) -> Callable[..., None]:
                def launch(*args: Any, **kwargs: Any) -> None:
                    assert all(isinstance(v, FarTensor) for v in args if isinstance(v, Tensor)), name
                    here = [v.here if isinstance(v, FarTensor) else v for v in args]

                    def run() -> None:
                        with torch._C.DisableTorchFunction():
                            kernel[grid](*here, **kwargs)

                    run()
                    if Graph.recording is not None:
                        Graph.recording.operations.append((run, (), {}, None))

                return launch

        return Grids()


@contextmanager
def pretended_cuda() -> Iterator[None]:
    """torch as if this machine had one CUDA device, one without fast bfloat16."""
    grouped, autocast = optimizer._group_tensors_by_device_and_dtype, torch.autocast

    def by_device(lists: Any, with_indices: bool = False) -> Any:
        groups = grouped(lists, with_indices)
        return {(CUDA if isinstance(v[0][0][0], FarTensor) else d, t): v for (d, t), v in groups.items()}

    replaced: dict[Any, dict[str, Any]] = {
        torch.cuda: {
            "is_available": lambda: True, "device_count": lambda: 1, "get_device_name": lambda _: "pretended",
            "get_device_capability": lambda _: (7, 5), "memory_allocated": lambda _: 0, "empty_cache": lambda: None,
            "Stream": _Stream, "stream": _Stream, "current_stream": _Stream, "CUDAGraph": Graph, "graph": recorded,
        },
        # Optimizers ask these. A CPU build of torch knows no accelerator, a CUDA build would look for a driver.
        torch.accelerator: {"current_accelerator": lambda check_available=False: CUDA, "current_stream": _Stream},
        torch: {"Generator": Generator, "autocast": lambda _, *args, **kwargs: autocast("cpu", *args, **kwargs)},
        nn.Module: {"to": _module_to},
        optimizer: {"_group_tensors_by_device_and_dtype": by_device},
    }  # fmt: skip
    with ExitStack() as stack:
        for owner, attributes in replaced.items():
            for name, value in attributes.items():
                stack.enter_context(mock.patch.object(owner, name, value))
        stack.enter_context(Rules())
        yield
