"""The processes that torchrun started, as one group that trains one model (data-parallel training).

They exchange gradients with gloo on a CPU and with NCCL on CUDA. If one of them fails, its connections close, every
exchange of the others fails at once, and all end. Why it failed is in torchrun's store of texts.
"""

from __future__ import annotations

import atexit
import hashlib
import itertools
import json
import os
import re
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed.distributed_c10d import PrefixStore
from torch.distributed.rendezvous import rendezvous

from nerf_core.common.errors import UserError
from nerf_core.methods.group import Group, Lost

PATIENCE = 600.0  # seconds that a process waits for the others: the first may write a large checkpoint meanwhile
REASON_SECONDS = 2.0  # a process that fails tells why before its connections close; one that was killed never does
FAILURE, OVER = "failure", "over"  # keys of the store
_groups = itertools.count()  # a process may join one after the other; their keys must differ


class Processes(Group):
    """The group of this process and of those that torchrun started with it."""

    def __init__(self, device: str) -> None:
        """Find the others. Raises UserError if they do not answer, or if they cannot have the device.

        device: "auto", "cpu" or "cuda".
        """
        self.local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        self.device = _device(device)
        backend = "gloo" if self.device == "cpu" else "cpu:gloo,cuda:nccl"
        wait = timedelta(seconds=PATIENCE)
        try:
            store, self.rank, self.size = next(iter(rendezvous("env://", timeout=wait)))
            self.store = PrefixStore(f"nerf-viewer/{next(_groups)}", store)
            dist.init_process_group(backend, store=self.store, rank=self.rank, world_size=self.size, timeout=wait)
        except (RuntimeError, ValueError) as error:
            raise Lost(f"the processes of torchrun do not find each other: {_line(error)}") from None

    def add(self, tensors: Sequence[Tensor]) -> None:
        if len(tensors) == 1 and tensors[0].is_contiguous():
            self._exchange(tensors[0])
            return
        flat = torch.cat([tensor.flatten() for tensor in tensors])  # one exchange costs less than many
        self._exchange(flat)
        for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def greatest(self, value: int) -> int:
        number = torch.tensor(value)
        self._exchange(number, dist.ReduceOp.MAX)
        return int(number)

    def compare(self, description: Mapping[str, Any], state: Mapping[str, Tensor]) -> None:
        for what, text in (
            ("scene, method, constants or step", json.dumps(description, sort_keys=True)),
            ("weights or random state", repr([(name, _sum_of_bits(value)) for name, value in state.items()])),
        ):
            digest = int.from_bytes(hashlib.sha256(text.encode()).digest()[:7])  # fits an int64, as does its negative
            if self.greatest(digest) != -self.greatest(-digest):
                raise UserError(
                    f"step {description['step']:,}: the processes of torchrun do not have the same {what}: give all "
                    "the same command, data and versions, and the same kind of device"
                )

    def _exchange(self, tensor: Tensor, operation: dist.ReduceOp.RedOpType = dist.ReduceOp.SUM) -> None:
        if tensor.is_cuda:
            self.greatest(0)  # NCCL would wait in vain for a process that has failed; gloo notices
        try:
            dist.all_reduce(tensor, operation)
        except RuntimeError as error:
            raise Lost(self._reason(error)) from None

    def _reason(self, error: RuntimeError) -> str:
        """Why an exchange failed, as the process says that failed; else what the library says."""
        end = time.monotonic() + REASON_SECONDS
        with suppress(RuntimeError):  # the store is gone if torchrun is
            while time.monotonic() < end:
                if self.store.check([FAILURE]):
                    return self.store.get(FAILURE).decode()
                time.sleep(0.05)
        return f"another process of torchrun ended or does not answer: {_line(error)}"

    def leave(self, error: BaseException) -> None:
        """End the group after an error in this process: the others' exchanges fail from now on.

        torchrun ends all processes as soon as one has ended with an error. So the first one ends first, when it has
        saved its run and printed what happened. If one was killed, torchrun ends the others already.
        """
        with suppress(RuntimeError):
            if not isinstance(error, Lost):
                self.store.compare_set(FAILURE, "", f"process {self.rank}: {_line(error)}")
        with suppress(RuntimeError):
            dist.destroy_process_group()
        atexit.register(self._end)

    def _end(self) -> None:
        """Say that the first process ends, or wait for that."""
        end = time.monotonic() + PATIENCE
        with suppress(RuntimeError):  # the store is gone if torchrun is
            if self.rank == 0:
                self.store.set(OVER, "1")
            while time.monotonic() < end and self.store.check([FAILURE]) and not self.store.check([OVER]):
                time.sleep(0.05)


@contextmanager
def together(device: str) -> Iterator[Processes]:
    """Join the group of torchrun's processes during the block. They leave it together.

    Args:
        device: "auto", "cpu" or "cuda"; `Processes.device` says which one this process has.

    Raises:
        UserError: the group cannot be joined.
        Lost: another process failed; the text says why.
    """
    group = Processes(device)
    try:
        yield group
        group.greatest(0)  # until the first process has saved: torchrun ends all once one has ended
    except BaseException as error:
        group.leave(error)
        raise
    dist.destroy_process_group()


def _device(name: str) -> str:
    """Return this process's own device: each has a GPU to itself."""
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return "cpu"
    if name not in ("auto", "cuda"):
        raise UserError(f"--device {name}: torchrun gives each process a GPU of its own: choose auto, cpu or cuda")
    number = int(os.environ.get("LOCAL_RANK", "0"))
    if number < torch.cuda.device_count():
        torch.cuda.set_device(number)  # NCCL and Triton use the current device
    return f"cuda:{number}"  # the trainer says so if there is no such device


def _sum_of_bits(value: Tensor) -> int:
    """A number that nearly always differs for tensors that differ: of large ones the sum of their bits as integers."""
    flat = value.detach().reshape(-1)
    if flat.dtype.itemsize == 4:
        return int(flat.view(torch.int32).sum(dtype=torch.int64))  # on the device, which is fast
    return zlib.crc32(flat.cpu().numpy().tobytes())


def _line(error: BaseException) -> str:
    """Return what an error says, as one line."""
    text = " ".join(str(error).split())
    if isinstance(error, UserError):
        return text
    words = re.sub(r"^\[[^]]*] *", "", text).partition(". ")[0]  # gloo begins with the line of its code
    return f"{type(error).__name__}: {words[:200]}"
