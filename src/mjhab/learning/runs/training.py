"""Updates of a student network: optimizer, learning rate schedule, moving average, and state for exact resumption."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mjhab.core.errors import MjhabError
from mjhab.learning.checkpoint import part_of, prefixed
from mjhab.learning.configs import OptimizerConfig
from mjhab.learning.devices import generator, reduced
from mjhab.learning.students.student import Batch, Student

WEIGHTS = "weights"
AVERAGE = "average"
FIRST_MOMENT = "first_moment"
SECOND_MOMENT = "second_moment"
"""Prefixes of the tensors in a training checkpoint."""


class BrokenLossError(MjhabError):
    """The loss or gradient became NaN or infinite; the update did not take place."""


@dataclass(frozen=True)
class UpdateReport:
    """Metrics of one update: the loss and the gradient norm before clipping."""

    loss: float
    gradient_norm: float


class Trainer:
    """Updates a student. Update k is a function of the weights, the batch, the seed and k only.

    ``step`` counts the updates; ``average`` is the moving average of the weights, which evaluations use.

    Args:
        student: network to train, on the device that it is trained on.
        seed: of the losses' random draws.
        updates: total number of updates, for the learning rate schedule.
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
        """Take one optimizer step; ``rate`` multiplies the scheduled learning rate.

        Raises:
            BrokenLossError: the loss or the gradient is not finite; the weights are unchanged.
        """
        config = self.config
        random = generator(self.seed, "update", self.step)
        self.student.train()
        precision = self.student.config.network.precision
        with reduced(precision, batch.actions.device):
            loss = self.student.loss(batch, random)
        value = float(loss.detach())
        # Before the gradient is taken: nan would reach all weights.
        if not math.isfinite(value):
            raise self._broken(f"the loss became {value}")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(
            self.student.parameters(), config.clip_norm or math.inf
        )
        if not math.isfinite(float(norm)):
            raise self._broken(f"the gradient became {float(norm)}")
        # Torch's schedulers keep a state of their own; this is a function of the step.
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * self._rate() * rate
        self.optimizer.step()
        self.step += 1
        self._follow()
        return UpdateReport(value, float(norm))

    def _broken(self, what: str) -> BrokenLossError:
        return BrokenLossError(
            f"{what} in batch {self.step + 1}. The weights from before it are kept; a smaller learning rate may help."
        )

    def restart_average(self) -> None:
        """Reset the moving average to the current weights and normalizers."""
        self.average.load_state_dict(self.student.state_dict())

    def _rate(self) -> float:
        """Factor of the schedule on the learning rate of the next update."""
        warmup = min(1.0, (self.step + 1) / max(self.config.warmup, 1))
        if self.config.schedule == "constant":
            return warmup
        return (
            warmup
            * 0.5
            * (1.0 + math.cos(math.pi * min(1.0, self.step / max(self.updates, 1))))
        )

    def _follow(self) -> None:
        """Update the moving average; its decay starts low and rises to ``config.ema``."""
        decay = (
            # A slow average would hold the random weights of the beginning for long.
            min(self.config.ema, (1 + self.step) / (10 + self.step))
            if self.config.ema
            else 0.0
        )
        with torch.no_grad():
            for kept, new in zip(
                self.average.parameters(), self.student.parameters(), strict=True
            ):
                kept.lerp_(new, 1.0 - decay)

    def tensors(self) -> dict[str, Tensor]:
        """State that the next update depends on, except ``step``, as named tensors for a checkpoint."""
        found = prefixed(WEIGHTS, self.student.state_dict())
        found |= prefixed(AVERAGE, self.average.state_dict())
        for name, parameter in self.student.named_parameters():
            state = self.optimizer.state.get(parameter)
            # Before the first update there is none.
            if state:
                found[f"{FIRST_MOMENT}/{name}"] = state["exp_avg"]
                found[f"{SECOND_MOMENT}/{name}"] = state["exp_avg_sq"]
        return found

    def restore(self, tensors: dict[str, Tensor], step: int) -> None:
        """Load the state that ``tensors`` returned after ``step`` updates.

        Raises:
            RuntimeError, KeyError, ValueError: they are those of another network.
        """
        self.student.load_state_dict(part_of(WEIGHTS, tensors))
        self.average.load_state_dict(part_of(AVERAGE, tensors))
        first = part_of(FIRST_MOMENT, tensors)
        second = part_of(SECOND_MOMENT, tensors)
        for name, parameter in self.student.named_parameters():
            if name in first:
                if not first[name].shape == second[name].shape == parameter.shape:
                    raise ValueError(
                        f"the moments of {name} have another shape than its weights"
                    )
                self.optimizer.state[parameter] = {
                    "step": torch.tensor(float(step)),
                    # Copied, because the optimizer changes it in place and the file's tensors stay.
                    "exp_avg": first[name].to(parameter.device, copy=True),
                    "exp_avg_sq": second[name].to(parameter.device, copy=True),
                }
        self.step = step
