"""Data-parallel training with torch.distributed: processes average gradients and statistics, not data.

Start it with `torchrun --nproc-per-node N -m -- mjhab.cli.main train ...`. Every process has its own worlds and seeds.
With a single process every function here leaves its input unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Iterable

import torch
import torch.distributed as dist
from torch import Tensor


def join() -> None:
    """Join the process group if torchrun started more than one process."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count > 1 and not dist.is_initialized():
        here = int(os.environ.get("LOCAL_WORLD_SIZE", count))
        dist.init_process_group(backends(here, torch.cuda.device_count()))


def backends(processes: int, gpus: int) -> str:
    """Backends of torch.distributed for ``processes`` on a machine with ``gpus``."""
    # NCCL refuses processes that share a GPU; gloo takes tensors of GPUs, too, by way of the host.
    if gpus < processes:
        return "gloo"
    # Networks lie on GPUs, while divergences, and worlds of backend cpu, are tensors of the host.
    return "cpu:gloo,cuda:nccl"


def rank() -> int:
    """Rank of this process; 0 without a process group."""
    return dist.get_rank() if dist.is_initialized() else 0


def processes() -> int:
    """Number of processes in the group; 1 without a group."""
    return dist.get_world_size() if dist.is_initialized() else 1


def average(tensors: Iterable[Tensor]) -> None:
    """Replace tensors by their mean over all processes, in place."""
    count = processes()
    if count == 1:
        return
    listed = list(tensors)
    # One message for all: each call waits for the slowest process.
    flat = torch.cat([tensor.detach().reshape(-1) for tensor in listed])
    dist.all_reduce(flat)
    flat /= count
    start = 0
    for tensor in listed:
        tensor.copy_(flat[start : start + tensor.numel()].view_as(tensor))
        start += tensor.numel()


def average_gradients(parameters: Iterable[torch.nn.Parameter]) -> None:
    """Average the gradients of the parameters over all processes, in place."""
    average([parameter.grad for parameter in parameters if parameter.grad is not None])


def mean_and_spread(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of values over all processes; each process must hold the same number of them."""
    moments = torch.stack([values.mean(), (values**2).mean()])
    average([moments])
    mean = moments[0]
    # Rounding may leave a little less than 0 of equal values.
    return mean, (moments[1] - mean**2).clamp(min=0.0).sqrt()


def gathered(values: Tensor) -> Tensor:
    """The values (n, ...) of all processes, (processes * n, ...) in the order of their ranks."""
    if processes() == 1:
        return values
    parts = [torch.zeros_like(values) for _ in range(processes())]
    dist.all_gather(parts, values)
    return torch.cat(parts)


def decided_by_first(judged: bool) -> bool:
    """Return the first process's value of ``judged`` in every process."""
    if processes() == 1:
        return judged
    flag = torch.tensor(float(judged))
    dist.broadcast(flag, 0)
    return bool(flag)


def wait() -> None:
    """Block until all processes have called this."""
    # Not dist.barrier, which guesses the GPU of a process from its rank.
    average([torch.zeros(1)])
