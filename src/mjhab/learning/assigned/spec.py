"""What ``mjhab policy join`` is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mjhab.core.errors import unknown_name
from mjhab.core.typed.bounds import Output, Positive
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options
from mjhab.learning.configs import VIEWS


@dataclass(frozen=True)
class PolicyJoinSpec:
    """Join trained policies to one that knows by the sentence which of them is asked for.

    `mjhab policy join POLICIES.json --out one.safetensors`

    The result is one checkpoint, for evaluation, serving and further training as any other; it sees what its members
    see, with the instruction in place of the one-hot condition. A gate, linear in the words, is fitted to the sentences
    of episodes that the members were trained in. Weights are stored as 16-bit numbers, those of
    encoders of whole views beside views of the target as 8-bit ones. Of a policy that was joined before, a request
    takes the network that acts on it, so that one of several can be exchanged.
    """

    policies: Annotated[Path, Flag(metavar="POLICIES.json|FOLDER", positional=True)]
    """A file of policies, or a folder of training runs (see `mjhab eval --policy`)."""
    out: Annotated[Path, Output(), Flag(metavar="FILE.safetensors")]
    """The new checkpoint."""
    views: str = ""
    """What every member is to see: whole (images of the cameras), target (views of the target) or both. It acts as
    before, since the weights of what is new to it are zero: a start for more training. If not given, each sees what it
    has seen so far."""
    episodes: Positive = 200
    """Episodes per request, of which the sentences are taken."""
    full: bool = False
    """Store 32-bit numbers."""

    def __post_init__(self) -> None:
        take_options(self)
        if self.views and self.views not in VIEWS:
            raise unknown_name("views", self.views, VIEWS)
