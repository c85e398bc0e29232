"""What ``mjhab policy join`` is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mjhab.core.typed.bounds import Output, Positive
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options


@dataclass(frozen=True)
class PolicyJoinSpec:
    """Join trained policies to one that knows by the sentence which of them is asked for.

    `mjhab policy join POLICIES.json --out one.safetensors`

    The result is one checkpoint, for evaluation, serving and further training as any other; it sees what its members
    see, with the instruction in place of the one-hot condition. A gate, linear in the words, is fitted to the sentences
    of episodes that the members were trained in. Weights are stored as 16-bit numbers.
    """

    policies: Annotated[Path, Flag(metavar="POLICIES.json|FOLDER", positional=True)]
    """A file of policies, or a folder of training runs (see `mjhab eval --policy`)."""
    out: Annotated[Path, Output(), Flag(metavar="FILE.safetensors")]
    """The new checkpoint."""
    episodes: Positive = 200
    """Episodes per request, of which the sentences are taken."""
    seed: int = 0
    """Seed of these episodes, and of the random words that the gate learns to ignore."""
    full: bool = False
    """Store 32-bit numbers."""

    def __post_init__(self) -> None:
        take_options(self)
