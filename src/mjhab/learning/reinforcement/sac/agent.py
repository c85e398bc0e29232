"""The agent of SAC: actor, distributional critics, target critics and entropy temperature."""

from __future__ import annotations

import copy
import itertools
import math

import torch
from torch import Tensor, nn

from mjhab.learning.networks import Encoder
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.configs import ReinforcementConfig
from mjhab.learning.reinforcement.networks import Critics
from mjhab.learning.students.gaussian import SquashedGaussian
from mjhab.learning.students.heads import make_student


class Judge(nn.Module):
    """The critics with their encoder; ``shared`` is the actor's encoder if actor and critics share all of one."""

    def __init__(
        self,
        config: ReinforcementConfig,
        layout: ObservationSpec,
        privileged: int,
        shared: Encoder | None,
    ) -> None:
        super().__init__()
        assert config.sac is not None
        self.encoder = shared or Encoder(config.student, layout)
        actions = len(layout.actions)
        width = self.encoder.width
        self.critics = Critics(config.student, config.sac, width, privileged, actions)

    def forward(self, seen: AgentObs, actions: Tensor) -> Tensor:
        """Output (critics, B, atoms or 1) of every critic for actions (B, A)."""
        features = self.encoder.joined(seen.vector, seen.images)
        return self.critics(features, seen.privileged, actions)


class Sac(nn.Module):
    """SAC agent: actor, critics, target critics and entropy temperature alpha.

    Args:
        config: of the whole run. layout: observations and actions of the actor.
        privileged: width of the input that only the critics receive.
        seed: of the initial weights. start: trained actor to start from.
    """

    def __init__(
        self,
        config: ReinforcementConfig,
        layout: ObservationSpec,
        privileged: int,
        seed: int,
        start: SquashedGaussian | None = None,
    ) -> None:
        super().__init__()
        assert config.sac is not None
        made = start or make_student(config.student, layout, seed)
        assert isinstance(made, SquashedGaussian)
        self.actor = made
        acting = self.actor.trunk.encoder
        published = config.network.encoder == "strided"
        whole = config.sac.share_encoder and not published
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + 1)
            self.judge = Judge(config, layout, privileged, acting if whole else None)
            if published and start is None:
                _begin_as_published(self.actor, self.judge)
        if published and config.sac.share_encoder:
            _share_convolutions(self.judge.encoder, acting)
        # After the encoders are shared, so that the copy shares none with the actor.
        self.target = copy.deepcopy(self.judge).requires_grad_(False)
        # The logarithm, so that alpha stays positive whatever the step.
        self.log_alpha = nn.Parameter(torch.tensor(math.log(config.sac.initial_alpha)))
        # The usual heuristic of SAC: one nat less per action (arXiv 1812.05905, App. D).
        self.target_entropy = -float(len(layout.actions))


def _share_convolutions(judging: Encoder, acting: Encoder) -> None:
    """Let two encoders have the same convolutions, and each its own layers behind them, as MS-HAB does."""
    for one, other in zip(judging.encoders, acting.encoders, strict=True):
        one.convolutions = other.convolutions


def _begin_as_published(*networks: nn.Module) -> None:
    """Initialize layers as MS-HAB does (mshab/agents/sac): orthogonal, no bias; convolutions act on their middle alone.

    So a convolution begins as an orthogonal map of the pixel below it (arXiv 1806.05393).
    """
    for layer in itertools.chain(*(network.modules() for network in networks)):
        if not isinstance(layer, nn.Linear | nn.Conv2d):
            continue
        assert layer.bias is not None
        nn.init.zeros_(layer.bias)
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight)
            continue
        nn.init.zeros_(layer.weight)
        with torch.no_grad():
            middle = torch.empty(layer.weight.shape[:2])
            row, column = (side // 2 for side in layer.kernel_size)
            layer.weight[:, :, row, column] = nn.init.orthogonal_(middle, math.sqrt(2.0))
