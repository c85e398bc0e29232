"""Devices that networks are trained on, and random numbers that are the same on all of them."""

from __future__ import annotations

import torch
from torch import Tensor

from mjhab.core.errors import unknown_name, warn_once
from mjhab.core.seeding import stream
from mjhab.learning.configs import BFLOAT16, FLOAT32

CPU = "cpu"
AUTO = "auto"
"""The first GPU if there is one, else the CPU."""


def training_device(name: str) -> torch.device:
    """The device of a name: cpu, auto, cuda or cuda:N.

    Raises:
        UsageError: this machine has no such device.
    """
    # Counted and not asked of torch.device, which takes any number.
    found = [f"cuda:{number}" for number in range(torch.cuda.device_count())]
    if name == AUTO:
        return torch.device(found[0] if found else CPU)
    if name == CPU:
        return torch.device(CPU)
    full = "cuda:0" if name == "cuda" else name
    if full not in found:
        raise unknown_name("device", name, [CPU, AUTO, *found])
    return torch.device(full)


def reduced(precision: str, device: torch.device) -> torch.autocast:
    """A context in which networks compute in a precision of `NetworkConfig`; losses are float32 in any case.

    Warns once where that takes longer than float32: on a processor that has to imitate bfloat16.
    """
    enabled = precision == BFLOAT16
    if enabled and device.type == CPU and not has_bfloat16():
        warn_once(
            f"network.precision={BFLOAT16} is slower than {FLOAT32} here: this processor has no such arithmetic "
            "(AVX512-BF16, AMX)."
        )
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled)


def has_bfloat16() -> bool:
    """Whether the processor multiplies numbers of bfloat16, which torch imitates where it does not."""
    tell = getattr(torch.cpu, "get_capabilities", None)
    if tell is None:
        # Older versions of torch do not say.
        return True
    has = tell()
    return any(has.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16"))


def generator(seed: int, name: str, number: int) -> torch.Generator:
    """A generator of torch that begins as the stream of a seed, a name and a number says."""
    drawn = stream(seed, name, number).integers(1 << 62)
    return torch.Generator().manual_seed(int(drawn))


def normal(
    shape: torch.Size | tuple[int, ...], random: torch.Generator, like: Tensor
) -> Tensor:
    """Standard normal numbers on the device of ``like``, drawn on the CPU by ``random``."""
    # A GPU's own generator draws other numbers, and runs would differ by device.
    return torch.randn(shape, generator=random).to(like.device)


def uniform(
    shape: torch.Size | tuple[int, ...], random: torch.Generator, like: Tensor
) -> Tensor:
    """Uniform numbers in [0, 1) on the device of ``like``, drawn on the CPU by ``random``."""
    return torch.rand(shape, generator=random).to(like.device)
