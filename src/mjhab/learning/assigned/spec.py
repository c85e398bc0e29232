"""What ``mjhab policy join`` and ``mjhab policy mean`` are asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mjhab.core.errors import unknown_name, wrong_value
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


@dataclass(frozen=True)
class PolicyMeanSpec:
    """Average the weights of policies that began alike, for instance of a policy before and after more training.

    `mjhab policy mean runs/close/student.safetensors before.safetensors --shares 0.6 0.4 --out close.safetensors`

    A policy that is trained on for other starts or homes often loses some of what it knew; the mean with the one
    before often keeps both (arXiv 2109.01903), and the mean of several such trainings is often better than each
    (arXiv 2203.05482). Policies that did not begin with the same weights have no useful mean.
    """

    policies: Annotated[
        tuple[Path, ...], Flag(metavar="FILE.safetensors ...", positional=True)
    ]
    """Two or more checkpoints. The result knows and sees what the first one does; the others may differ from it as what
    `mjhab train dagger --start` begins with, for instance be a joined policy that the first one began with."""
    out: Annotated[Path, Output(), Flag(metavar="FILE.safetensors")]
    """The new checkpoint."""
    shares: tuple[float, ...] = ()
    """Share of each, in the order of the policies; equal ones if not given. Their sum need not be 1."""

    def __post_init__(self) -> None:
        take_options(self)
        if len(self.policies) < 2:
            raise wrong_value("policies", len(self.policies), "two or more checkpoints")
        if self.shares and (
            len(self.shares) != len(self.policies)
            or not all(0.0 < share < math.inf for share in self.shares)
        ):
            raise wrong_value(
                "shares",
                self.shares,
                f"one number above 0 for each of the {len(self.policies)} policies",
            )
