"""Checkpoints of the original: which of its four networks one holds, and whether every parameter fits."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mjhab.core.errors import UsageError
from mjhab.learning.ms_hab import ppo, sac
from mjhab.learning.ms_hab.bc import Bc
from mjhab.learning.ms_hab.dp import Dp
from mjhab.learning.ms_hab.network import Network, Shapes
from mjhab.learning.ms_hab.ppo import Ppo
from mjhab.learning.ms_hab.sac import Sac

AGENT = "agent"
"""Key of a checkpoint under which the original keeps the parameters of the policy (mshab/train_*.py)."""
_SHOWN_KEYS = 6


@dataclass(frozen=True)
class Layout:
    """One of the original's networks. ``mark``: what the keys of no other begin with; ``training_only``: beginnings of
    keys that acting does not need."""

    name: str
    mark: str
    build: Callable[[Shapes], Network]
    training_only: tuple[str, ...] = ()


LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout("sac", "actor.encoder.", Sac, sac.TRAINING_ONLY),
        Layout("ppo", "feature_net.", Ppo, ppo.TRAINING_ONLY),
        Layout("bc", "extractors.", Bc),
        Layout("dp", "noise_pred_net.", Dp),
    )
}


def load_network(path: Path) -> tuple[str, Network]:
    """Read a checkpoint of the original; returns the name of its layout and the network, on the CPU, for inference.

    Nothing but tensors and plain data is read from the file, and nothing in it is executed.

    Raises:
        UsageError: no such file, not a checkpoint, one that needs more than tensors, or one of another layout.
    """
    parameters = _parameters(path, _read(path))
    shapes = {key: tuple(value.shape) for key, value in parameters.items()}
    layout = _recognise(path, shapes)
    used = {
        key: value for key, value in parameters.items() if not key.startswith(layout.training_only)
    }
    shapes = {key: shapes[key] for key in used}
    try:
        network = layout.build(shapes)
    except (ValueError, RuntimeError) as error:
        raise UsageError(
            f"{path} has the keys of MS-HAB's {layout.name.upper()} network, but its sizes do not go together: {error}."
        ) from error
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    wrong = _differences(expected, shapes)
    if wrong:
        raise UsageError(
            f"{path} has the keys of MS-HAB's {layout.name.upper()} network, but not its layout: {'; '.join(wrong)}. "
            "Give a checkpoint as the original's train scripts save it (policy.pt), with images of 128 x 128."
        )
    network.load_state_dict(used)
    return layout.name, network.eval().requires_grad_(False)


def _read(path: Path) -> Any:
    if not path.is_file():
        raise UsageError(
            f"{path} does not exist or is no file; give a checkpoint of MS-HAB, such as policy.pt."
        )
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        needed = _unsafe_names(path)
        if not needed:
            raise UsageError(
                f"{path} cannot be read as a checkpoint of torch: {_first_line(error)}"
            ) from error
        raise UsageError(
            f"{path} needs more than tensors and was refused; nothing in it was executed. It asks for: "
            f"{', '.join(needed)}. Save the parameters alone: torch.save({{'agent': agent.state_dict()}}, path)."
        ) from error
    except (RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
        raise UsageError(
            f"{path} cannot be read as a checkpoint of torch: {_first_line(error)}"
        ) from error


def _unsafe_names(path: Path) -> list[str]:
    """What a file asks for besides tensors, found without loading it."""
    try:
        return sorted(torch.serialization.get_unsafe_globals_in_checkpoint(str(path)))
    except (RuntimeError, ValueError, OSError, pickle.UnpicklingError):
        return []


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _parameters(path: Path, content: Any) -> dict[str, Tensor]:
    """The parameters of the policy: under AGENT, or the whole file."""
    agent = content.get(AGENT, content) if isinstance(content, Mapping) else content
    if (
        not isinstance(agent, Mapping)
        or not agent
        or not all(isinstance(value, Tensor) for value in agent.values())
    ):
        held = (
            ", ".join(map(str, content)) if isinstance(content, Mapping) else type(content).__name__
        )
        raise UsageError(
            f"{path} holds no parameters of a policy: expected a dict of tensors under {AGENT!r}; it holds {held}."
        )
    return {str(key): value for key, value in agent.items()}


def _recognise(path: Path, shapes: Shapes) -> Layout:
    """The layout whose mark is among the keys.

    Raises:
        UsageError: there is none; the message compares the keys with those of the nearest.
    """
    for layout in LAYOUTS.values():
        if any(key.startswith(layout.mark) for key in shapes):
            return layout
    published = {name: layout.build({}).state_dict() for name, layout in LAYOUTS.items()}
    nearest = max(published, key=lambda name: len(_parts(published[name]) & _parts(shapes)))
    missing = [key for key in published[nearest] if key not in shapes]
    extra = [key for key in shapes if key not in published[nearest]]
    raise UsageError(
        f"{path} is of another layout than MS-HAB's {', '.join(name.upper() for name in LAYOUTS)}. Nearest is "
        f"{nearest.upper()}: {_listed('missing', missing)}; {_listed('too many', extra)}."
    )


def _parts(keys: Mapping[str, Any]) -> set[str]:
    """Every beginning and end of dotted keys, to compare layouts of which one lies inside another."""
    pieces = [key.split(".") for key in keys]
    return {".".join(p[:i]) for p in pieces for i in range(1, len(p) + 1)} | {
        ".".join(p[i:]) for p in pieces for i in range(len(p))
    }


def _differences(expected: Shapes, given: Shapes) -> list[str]:
    """How the parameters given differ from those expected, in words; empty if they do not."""
    missing = [key for key in expected if key not in given]
    extra = [key for key in given if key not in expected]
    other = [
        f"{key} {given[key]} instead of {shape}"
        for key, shape in expected.items()
        if given.get(key, shape) != shape
    ]
    named = (("missing", missing), ("too many", extra), ("of another shape", other))
    return [_listed(what, keys) for what, keys in named if keys]


def _listed(what: str, keys: Sequence[str]) -> str:
    more = f" and {len(keys) - _SHOWN_KEYS} more" if len(keys) > _SHOWN_KEYS else ""
    return f"{what}: {', '.join(keys[:_SHOWN_KEYS]) or 'none'}{more}"
