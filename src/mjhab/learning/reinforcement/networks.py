"""Critic networks: state values for PPO and state-action values for SAC."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mjhab.learning.configs import StudentConfig
from mjhab.learning.networks import MOST_SPREADS, Encoder, Normalizer, mlp
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.configs import SacConfig


class Value(nn.Module):
    """State value network with its own encoder; ``privileged`` is the width P of the privileged input."""

    def __init__(
        self, config: StudentConfig, layout: ObservationSpec, privileged: int
    ) -> None:
        super().__init__()
        # Of its own: gradients of values would spoil the features that the actor acts by.
        self.encoder = Encoder(config, layout)
        self.privileged = Normalizer(privileged, MOST_SPREADS)
        network = config.network
        widths = [self.encoder.width + privileged, *[network.hidden] * network.layers, 1]
        self.layers = mlp(widths, norm=network.norm, last=False)

    def forward(self, seen: AgentObs) -> Tensor:
        """State values (B,)."""
        features = self.encoder.joined(seen.vector, seen.images)
        return self.layers(
            torch.cat([features, self.privileged(seen.privileged)], dim=1)
        )[:, 0]


class Critics(nn.Module):
    """Ensemble of state-action critics, scalar or with a categorical return distribution (C51, arXiv 1707.06887).

    Layer norm bounds the values of actions outside the data (arXiv 2302.02948).

    Args:
        config: supplies the network sizes. sac: supplies the number of critics and atoms.
        features, privileged, actions: widths of the three inputs.
    """

    support: Tensor

    def __init__(
        self,
        config: StudentConfig,
        sac: SacConfig,
        features: int,
        privileged: int,
        actions: int,
    ) -> None:
        super().__init__()
        network = config.network
        outputs = max(sac.atoms, 1)
        widths = [
            features + privileged + actions,
            *[network.hidden] * network.layers,
            outputs,
        ]
        self.privileged = Normalizer(privileged, MOST_SPREADS)
        self.heads = nn.ModuleList(
            mlp(widths, norm=True, last=False) for _ in range(sac.critics)
        )
        self.atoms = sac.atoms
        support = torch.linspace(sac.value_low, sac.value_high, outputs)
        self.register_buffer("support", support)

    def forward(self, features: Tensor, privileged: Tensor, actions: Tensor) -> Tensor:
        """Logits (critics, B, atoms) of the return distributions, or values (critics, B, 1) of scalar critics."""
        joined = torch.cat([features, self.privileged(privileged), actions], dim=1)
        return torch.stack([head(joined) for head in self.heads])

    def values(self, said: Tensor) -> Tensor:
        """Expected returns (critics, B) from the output of ``forward``."""
        if not self.atoms:
            return said[..., 0]
        return (said.softmax(dim=-1) * self.support).sum(dim=-1)

    def project(self, probabilities: Tensor, targets: Tensor) -> Tensor:
        """Project a distribution onto the support: returns ``targets`` (B, atoms) with ``probabilities`` (B, atoms)."""
        low = self.support[0]
        width = self.support[1] - low
        # Returns beyond the support count as its ends.
        places = ((targets - low) / width).clamp(0, self.atoms - 1)
        below = places.floor()
        share = places - below
        found = torch.zeros_like(probabilities)
        found.scatter_add_(1, below.long(), probabilities * (1.0 - share))
        above = (below + 1).clamp(max=self.atoms - 1).long()
        # At the last atom the share is 0, so that the clamped place gets nothing.
        found.scatter_add_(1, above, probabilities * share)
        return found
