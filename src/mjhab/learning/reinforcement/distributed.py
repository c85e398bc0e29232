"""Several processes that learn together: gradients and statistics are averaged, data stay where they were made.

Started by `torchrun --nproc-per-node N -m mjhab.cli.main train ...`. Every process has its own worlds and seeds.
"""

from __future__ import annotations

import os
from collections.abc import Iterable

import torch
import torch.distributed as dist
from torch import Tensor


def join() -> None:
    """Join the processes that torchrun started, if there are others."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")


def rank() -> int:
    """Number of this process, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def processes() -> int:
    """How many processes learn together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def average(tensors: Iterable[Tensor]) -> None:
    """Replace tensors by their mean over all processes, in place."""
    count = processes()
    if count == 1:
        return
    listed = list(tensors)
    flat = torch.cat([tensor.detach().reshape(-1) for tensor in listed])
    dist.all_reduce(flat)
    flat /= count
    start = 0
    for tensor in listed:
        tensor.copy_(flat[start : start + tensor.numel()].view_as(tensor))
        start += tensor.numel()


def average_gradients(parameters: Iterable[torch.nn.Parameter]) -> None:
    """Average the gradients over all processes; the gradient of a mean over all their samples."""
    average([parameter.grad for parameter in parameters if parameter.grad is not None])


def mean_and_spread(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of values over all processes, which have equally many."""
    moments = torch.stack([values.mean(), (values**2).mean()])
    average([moments])
    mean = moments[0]
    return mean, (moments[1] - mean**2).clamp(min=0.0).sqrt()


def told_by_first(judged: bool) -> bool:
    """What the first process judges, in all of them."""
    if processes() == 1:
        return judged
    device = "cuda" if dist.get_backend() == "nccl" else "cpu"
    flag = torch.tensor(float(judged), device=device)
    dist.broadcast(flag, 0)
    return bool(flag)


def wait() -> None:
    """Go on when all processes have come here."""
    if processes() > 1:
        dist.barrier()
