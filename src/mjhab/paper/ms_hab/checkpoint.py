"""Checkpoints of MS-HAB: recognition of the network (one of four) and check of every parameter's shape."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from mjhab.core.errors import fault
from mjhab.data.imports.torch_files import read_torch
from mjhab.learning.checkpoint import check_finite
from mjhab.paper.ms_hab import ppo, sac
from mjhab.paper.ms_hab.bc import Bc
from mjhab.paper.ms_hab.dp import Dp
from mjhab.paper.ms_hab.network import Network, Shapes
from mjhab.paper.ms_hab.ppo import PpoNetwork
from mjhab.paper.ms_hab.sac import SacNetwork

AGENT = "agent"
"""Key of a checkpoint under which MS-HAB stores the parameters of the policy (mshab/train_*.py)."""
_SHOWN_KEYS = 6
_WHAT = "a checkpoint of torch, such as policy.pt of MS-HAB"
_SAVE_ALONE = (
    "Save the parameters alone: torch.save({'agent': agent.state_dict()}, path)."
)


@dataclass(frozen=True)
class NetworkKind:
    """One of MS-HAB's networks.

    mark: prefix of parameter names that no other network has. build: makes the network from the parameters' shapes.
    training_only: prefixes of parameters that inference does not need.
    """

    name: str
    mark: str
    build: Callable[[Shapes], Network]
    training_only: tuple[str, ...] = ()


LAYOUTS: dict[str, NetworkKind] = {
    layout.name: layout
    for layout in (
        NetworkKind("sac", "actor.encoder.", SacNetwork, sac.TRAINING_ONLY),
        NetworkKind("ppo", "feature_net.", PpoNetwork, ppo.TRAINING_ONLY),
        NetworkKind("bc", "extractors.", Bc),
        NetworkKind("dp", "noise_pred_net.", Dp),
    )
}


def load_network(path: Path) -> tuple[str, Network]:
    """Read a checkpoint of MS-HAB; returns the name of its layout and the network, on the CPU, for inference.

    Only tensors and plain data are read from the file; no code in it is executed.

    Raises:
        UsageError: the file does not exist, is not a checkpoint, contains more than tensors, has another layout, or
            holds weights that are not finite.
    """
    content = read_torch(path, _WHAT, _SAVE_ALONE)
    parameters = _parameters(path, content)
    shapes = {key: tuple(value.shape) for key, value in parameters.items()}
    layout = _recognise(path, shapes)
    used = {
        key: value
        for key, value in parameters.items()
        # Nothing here asks critics, whatever their form.
        if not key.startswith(layout.training_only)
    }
    shapes = {key: shapes[key] for key in used}
    try:
        network = layout.build(shapes)
    except (ValueError, RuntimeError) as error:
        raise fault(
            path,
            f"has the keys of MS-HAB's {layout.name.upper()} network, but inconsistent sizes: {error}.",
        ) from error
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    wrong = _differences(expected, shapes)
    if wrong:
        raise fault(
            path,
            f"has the keys of MS-HAB's {layout.name.upper()} network, but not its layout: {'; '.join(wrong)}. "
            "Give a checkpoint as MS-HAB's train scripts save it (policy.pt), with images of 128 x 128.",
        )
    # Before loading: NaN in a layer would only show in the actions.
    check_finite(path, used)
    network.load_state_dict(used)
    return layout.name, network.eval().requires_grad_(False)


def _parameters(path: Path, content: Any) -> dict[str, Tensor]:
    """The parameters of the policy: those under AGENT, or the whole content."""
    agent = content.get(AGENT, content) if isinstance(content, Mapping) else content
    if (
        not isinstance(agent, Mapping)
        or not agent
        or not all(isinstance(value, Tensor) for value in agent.values())
    ):
        held = (
            ", ".join(map(str, content))
            if isinstance(content, Mapping)
            else type(content).__name__
        )
        raise fault(
            path,
            f"holds no parameters of a policy: expected a dict of tensors under {AGENT!r}; it holds {held}.",
        )
    return {str(key): value for key, value in agent.items()}


def _recognise(path: Path, shapes: Shapes) -> NetworkKind:
    """Return the layout whose mark is a prefix of some key.

    Raises:
        UsageError: there is none; the message compares the keys with those of the most similar layout.
    """
    for layout in LAYOUTS.values():
        if any(key.startswith(layout.mark) for key in shapes):
            return layout
    # Built in the published sizes, to have keys to compare with.
    published = {name: layout.build({}).state_dict() for name, layout in LAYOUTS.items()}
    nearest = max(
        published, key=lambda name: len(_parts(published[name]) & _parts(shapes))
    )
    missing = [key for key in published[nearest] if key not in shapes]
    extra = [key for key in shapes if key not in published[nearest]]
    raise fault(
        path,
        f"of another layout than MS-HAB's {', '.join(name.upper() for name in LAYOUTS)}. Nearest is "
        f"{nearest.upper()}: {_listed('missing', missing)}; {_listed('too many', extra)}.",
    )


def _parts(keys: Mapping[str, Any]) -> set[str]:
    """All dotted prefixes and suffixes of the keys, to compare layouts of which one is nested in another."""
    pieces = [key.split(".") for key in keys]
    return {".".join(p[:i]) for p in pieces for i in range(1, len(p) + 1)} | {
        ".".join(p[i:]) for p in pieces for i in range(len(p))
    }


def _differences(expected: Shapes, given: Shapes) -> list[str]:
    """Describe how the given parameters differ from the expected ones; empty if they match."""
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
