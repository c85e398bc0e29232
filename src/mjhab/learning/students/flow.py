"""Flow matching: a velocity field from noise to the demonstrated chunk, integrated with a few Euler steps."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mjhab.learning.configs import StudentConfig
from mjhab.learning.devices import normal, uniform
from mjhab.learning.networks import Normalizer, Trunk, mlp
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.student import Batch, Student

TIME_FREQUENCIES = 8
"""Number of sine-cosine pairs that encode the time of the flow."""


class FlowMatching(Student):
    """A trunk for the observations and a small network for the velocity at a point between noise and actions."""

    frequencies: Tensor

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__(config, layout)
        self.trunk = Trunk(config, layout)
        width = config.network.hidden
        numbers = config.chunk * len(layout.actions)
        self.velocity = nn.Sequential(
            mlp(
                [self.trunk.width + numbers + 2 * TIME_FREQUENCIES, width, width],
                norm=True,
            ),
            nn.Linear(width, numbers),
        )
        self.register_buffer(
            # From a sixteenth of a turn, in which no two times look alike, to eight turns for fine steps.
            "frequencies",
            torch.pi * 2.0 ** torch.arange(TIME_FREQUENCIES) / 8.0,
        )

    @property
    def normalizer(self) -> Normalizer:
        return self.trunk.normalizer

    @property
    def draws(self) -> int:
        return 1

    def flow(self, seen: Tensor, point: Tensor, time: Tensor) -> Tensor:
        """Velocity (B, chunk, A) at a point (B, chunk, A) and time (B,): 0 is the noise, 1 the actions."""
        angles = time[:, None] * self.frequencies
        clock = torch.cat([angles.sin(), angles.cos()], dim=1)
        return self.velocity(torch.cat([seen, point.flatten(1), clock], dim=1)).unflatten(
            1, point.shape[1:]
        )

    def loss(self, batch: Batch, random: torch.Generator) -> Tensor:
        target = self.targets(batch)
        noise = normal(target.shape, random, target)
        time = uniform((len(target),), random, target)
        point = torch.lerp(noise, target, time[:, None, None])
        velocity = self.flow(self.trunk(batch.vector, batch.images), point, time)
        return self.error(velocity, batch, target - noise)

    def chunk(self, vector: Tensor, images: Tensor, noise: Tensor) -> Tensor:
        seen = self.trunk(vector, images)
        steps = self.config.sampling_steps
        point = noise[:, 0]
        for step in range(steps):
            time = torch.full((len(noise),), step / steps, device=noise.device)
            # The trunk ran once: only the small network runs in every step.
            point = point + self.flow(seen, point, time) / steps
        return self.action_normalizer.restore(point)
