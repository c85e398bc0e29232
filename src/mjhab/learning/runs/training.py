"""The updates of a network: optimizer, schedule, moving average; what is needed to go on exactly."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mjhab.core.errors import MjhabError
from mjhab.core.seeding import stream
from mjhab.learning.configs import OptimizerConfig
from mjhab.learning.students.student import Batch, Student

WEIGHTS = "weights"
AVERAGE = "average"
FIRST_MOMENT = "first_moment"
SECOND_MOMENT = "second_moment"


class BrokenLossError(MjhabError):
    """The loss became NaN or infinite; what was learned before is in the last checkpoint."""


@dataclass(frozen=True)
class UpdateReport:
    """What an update tells: the loss and the norm of the gradient before it was limited."""

    loss: float
    gradient_norm: float


class Trainer:
    """Updates a student. Update k is a function of the weights, its batch, the seed and k alone.

    Args:
        student: what is trained; on the CPU.
        seed: of what the losses draw.
        updates: in all, for a schedule that ends.

    ``step`` counts the updates; ``average`` is the student that acts.
    """

    def __init__(self, student: Student, seed: int, updates: int) -> None:
        self.student = student
        self.seed = seed
        self.updates = updates
        self.config: OptimizerConfig = student.config.optimizer
        self.average = copy.deepcopy(student).eval().requires_grad_(False)
        self.step = 0
        self.optimizer = torch.optim.AdamW(
            student.parameters(),
            lr=self.config.learning_rate,
            betas=self.config.betas,
            weight_decay=self.config.weight_decay,
        )

    def update(self, batch: Batch, rate: float = 1.0) -> UpdateReport:
        """Take one step of the optimizer, with this share of the scheduled learning rate.

        Raises:
            BrokenLossError: the loss is not finite; nothing was changed.
        """
        config = self.config
        random = torch.Generator().manual_seed(
            int(stream(self.seed, "update", self.step).integers(1 << 62))
        )
        self.student.train()
        loss = self.student.loss(batch, random)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise self._broken(f"the loss became {value}")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(
            self.student.parameters(), config.clip_norm or math.inf
        )
        if not math.isfinite(float(norm)):
            raise self._broken(f"the gradient became {float(norm)}")
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * self._rate() * rate
        self.optimizer.step()
        self.step += 1
        self._follow()
        return UpdateReport(value, float(norm))

    def _broken(self, what: str) -> BrokenLossError:
        return BrokenLossError(
            f"{what} in batch {self.step + 1}. The last good checkpoint is kept; a smaller learning rate may help."
        )

    def restart_average(self) -> None:
        """Let the moving average begin anew from the weights, normalization among them."""
        self.average.load_state_dict(self.student.state_dict())

    def _rate(self) -> float:
        """Share of the learning rate in the coming update."""
        warmup = min(1.0, (self.step + 1) / max(self.config.warmup, 1))
        if self.config.schedule == "constant":
            return warmup
        return warmup * 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.step / max(self.updates, 1))))

    def _follow(self) -> None:
        """Move the average towards the weights; it is quick at the beginning, when there is little to average."""
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step)) if self.config.ema else 0.0
        with torch.no_grad():
            for kept, new in zip(self.average.parameters(), self.student.parameters(), strict=True):
                kept.lerp_(new, 1.0 - decay)

    def tensors(self) -> dict[str, Tensor]:
        """Everything that the next update depends on, besides ``step``, by name."""
        found: dict[str, Tensor] = {}
        for name, value in self.student.state_dict().items():
            found[f"{WEIGHTS}/{name}"] = value
        for name, value in self.average.state_dict().items():
            found[f"{AVERAGE}/{name}"] = value
        for name, parameter in self.student.named_parameters():
            state = self.optimizer.state.get(parameter)
            if state:
                found[f"{FIRST_MOMENT}/{name}"] = state["exp_avg"]
                found[f"{SECOND_MOMENT}/{name}"] = state["exp_avg_sq"]
        return found

    def restore(self, tensors: dict[str, Tensor], step: int) -> None:
        """Take over what ``tensors`` gave after ``step`` updates."""
        self.student.load_state_dict(_part(tensors, WEIGHTS))
        self.average.load_state_dict(_part(tensors, AVERAGE))
        first = _part(tensors, FIRST_MOMENT)
        second = _part(tensors, SECOND_MOMENT)
        for name, parameter in self.student.named_parameters():
            if name in first:
                self.optimizer.state[parameter] = {
                    "step": torch.tensor(float(step)),
                    "exp_avg": first[name].clone(),
                    "exp_avg_sq": second[name].clone(),
                }
        self.step = step


def _part(tensors: dict[str, Tensor], part: str) -> dict[str, Tensor]:
    return {
        name.removeprefix(f"{part}/"): value
        for name, value in tensors.items()
        if name.startswith(f"{part}/")
    }
