"""The agent of SAC: actor, distributional critics, target critics and entropy temperature."""

from __future__ import annotations

import copy
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
    """The critics with their encoder; ``shared`` is the actor's encoder if actor and critics share one."""

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
        shared = self.actor.trunk.encoder if config.sac.share_encoder else None
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + 1)
            self.judge = Judge(config, layout, privileged, shared)
        self.target = copy.deepcopy(self.judge).requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.tensor(math.log(config.sac.initial_alpha)))
        self.target_entropy = -float(len(layout.actions))
