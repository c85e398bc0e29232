"""A run of reinforcement learning: the worlds that it acts in, for both PPO and SAC."""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.seeding import stream
from mjhab.envs.parts.reporting import CHECKERS
from mjhab.learning.devices import training_device
from mjhab.learning.observation.spec import ObservationSpec, observation_spec_of
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder
from mjhab.learning.reinforcement.configs import REST_TOLERANCES
from mjhab.learning.reinforcement.environments import training_env
from mjhab.learning.reinforcement.request import start_of
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.reinforcement.worlds import TrainingRules, Transition, Worlds
from mjhab.learning.runs import distributed
from mjhab.learning.runs.budget import BudgetTooSmallError, FirstUpdate, StepClock
from mjhab.learning.runs.run import TrainingFolder
from mjhab.learning.runs.session import Session
from mjhab.learning.runs.specs import Resources
from mjhab.learning.students.heads import check_student
from mjhab.learning.students.student import Student
from mjhab.tasks.subtasks.registry import SUBTASKS, limits_of
from mjhab.tasks.thresholds import TaskConfig

REPLAY = "replay"
DEMONSTRATIONS = "demonstrations"
"""Folders of a run's replay buffers."""
RECENT_EPISODES = 200
"""Number of most recent training episodes that the reported training success rate covers."""
EVALUATION_WORLDS = 16
"""Most worlds of an evaluation."""


class Learner(Protocol):
    """What a session asks of its algorithm, an `AlgorithmRun`."""

    @property
    def actor(self) -> Student:
        """What acts and is evaluated."""
        ...

    def prepare(self) -> None:
        """Make or read the demonstrations and imitate them, if the config asks for it."""
        ...

    def learn(self) -> None:
        """Train until the run's number of samples is reached."""
        ...

    def save(self) -> None:
        """Write a checkpoint."""
        ...


class ReinforcementSession(Session):
    """A run of reinforcement learning. Make one with `train.open_reinforcement`, which sets the algorithm, ``run``."""

    spec: ReinforcementSpec
    run: Learner

    def __init__(
        self,
        spec: ReinforcementSpec,
        folder: TrainingFolder,
        checkpoint: Path,
    ) -> None:
        threads = spec.config.inputs.network_threads(spec.threads)
        if threads:
            torch.set_num_threads(threads)
        super().__init__(spec, folder, checkpoint)
        self.start = start_of(spec)
        self.config = spec.config
        if self.start is not None:
            self.config = dataclasses.replace(
                spec.config, inputs=self.start.config.inputs
            )
            # The student can act before its first update.
            self.state.trained = self.began_trained = True
        self.keep_best_by = self.config.keep_best_by
        self.judging = Resources(
            worlds=min(EVALUATION_WORLDS, self.config.worlds), threads=spec.threads
        )
        # Each process draws its own episodes and its own noise.
        self.seed = spec.seed + 1_000_003 * distributed.rank()
        self.env = training_env(
            spec.scene,
            self.config.inputs,
            self.config.worlds,
            spec.threads,
            self.seed,
            backend=spec.asked.backend,
            device=spec.asked.device,
            **self._episodes(),
        )
        layout = self._layout()
        check_student(self.config.student, layout)
        self.settle(layout)
        named = spec.network_device
        encoder = AgentEncoder(
            self.env,
            layout,
            self.config.privileged_critic,
            training_device(named) if named else None,
        )
        self.privileged_width = encoder.privileged_width
        self.worlds = Worlds(self.env, encoder, self._episodes_seed(), self._rules())
        self.demonstrations = 0
        """Number of episodes in the demonstration buffer."""
        self.learner_seconds = 0.0
        """Wall time of the updates since this process started the run [s]."""
        self._began = time.perf_counter()
        self._prepared = False
        self._steps = StepClock()
        self._outcomes: deque[bool] = deque(maxlen=RECENT_EPISODES)
        self._rewards: deque[float] = deque(maxlen=100)

    @property
    def policy(self) -> Student:
        """The actor."""
        return self.run.actor

    def _rules(self) -> TrainingRules:
        """Rules of training episodes in addition to those of the environment."""
        subtask = self.spec.scene.subtask
        limits = limits_of(self.env.task_config, subtask)
        conditions = SUBTASKS[subtask].conditions
        return TrainingRules(
            longest_first=limits.horizon if self.config.stagger else 0,
            force_limit=limits.force_limit,
            force_ends=self.config.force_ends,
            force_cost=self.config.force_cost,
            success_ends=self.config.success_ends,
            paid_steps=self.config.paid_steps,
            conditions=tuple(name for name in conditions if name in CHECKERS),
        )

    def _episodes(self) -> dict[str, Any]:
        """Environment options of the config. Navigate keeps the longer horizon of its profile."""
        options: dict[str, Any] = {
            "horizon": self.config.horizon,
            "episode_pool": self.config.episode_pool,
            "reward_mode": self.config.reward_mode,
            "stillness": self.spec.scene.stillness or self.config.stillness,
        }
        if self.config.rest_share < 1.0:
            options["overrides"] = {
                name: self.config.rest_share * getattr(TaskConfig, name)
                for name in REST_TOLERANCES
            }
        if SUBTASKS[self.spec.scene.subtask].navigates:
            del options["horizon"]
        return {name: value for name, value in options.items() if value}

    def _layout(self) -> ObservationSpec:
        """Observation and action layout: that of the start checkpoint, else derived from the environment."""
        if self.start is not None:
            # The student was trained with demonstrations of the same profile; see `ObservationSpec.check_env`.
            self.start.layout.check_env(self.env)
            return self.start.layout
        from mjhab.episodes.starts import aims_of

        targets = aims_of(self.env.config, self.env.layout)
        layout = observation_spec_of(self.env, self.config.inputs, targets)
        if self.saved is not None:
            # An older version began the run with other conventions, perhaps; its weights keep them.
            layout = layout.in_conventions(self.saved.layout.conventions)
        # Training episodes may be of another stillness, by which the environment's profile is not recognised.
        return dataclasses.replace(
            layout, profile=self.spec.scene.profile or layout.profile
        )

    # -- the run -----------------------------------------------------------------------------------------------------

    def learn(self) -> None:
        """Prepare the algorithm, evaluate its actor, and let it learn."""
        self.run.prepare()
        self._prepared = True
        self.check_time()
        if self.spec.round_episodes and not self.state.evaluated:
            self.evaluate(self.spec.round_episodes)
        try:
            self.run.learn()
        except BudgetTooSmallError:
            # Its few steps are no part of the run: a larger budget begins anew.
            self._prepared = False
            raise

    def finish(self) -> None:
        """Write the last checkpoint, and choose the best actor."""
        # Of a run that was ended within its imitation the rest would never be made.
        if self._prepared:
            self.run.save()
        else:
            # A checkpoint would be resumed without the rest of the imitation.
            self.stop(broken=False)
        self.keep_best()

    def stop(self, broken: bool) -> None:
        """Make the actor of this moment the run's student if it was ever updated, after Ctrl-C.

        The training checkpoint stays that of the last regular one, so a resumed run is exactly repeated from there.
        After a broken loss the student stays that one, too: earlier minibatches of the update have changed the actor.
        """
        if self.state.trained and not broken and not distributed.rank():
            self.save_policy()

    def save(self, actor: Student, tensors: dict[str, Tensor]) -> None:
        """Write the training and the student checkpoint, and start new episodes in all worlds.

        The new episodes make an uninterrupted run equal to one that is resumed from this checkpoint.
        """
        self.write_checkpoint(actor, tensors)
        self.worlds.begin(self._episodes_seed())

    def _episodes_seed(self) -> int:
        """Seed of the episodes after the latest checkpoint; runs of other seeds have none in common."""
        # By the number of checkpoints, so that a resumed run begins the same episodes.
        drawn = stream(self.seed, "episodes", self.state.checkpoints)
        # Gymnasium's seeds are below this.
        return int(drawn.integers(1 << 31))

    # -- progress -----------------------------------------------------------------------------------------------------

    def note(self, transition: Transition) -> None:
        """Count one control step of all worlds and remember its rewards and finished episodes.

        Raises:
            BudgetTooSmallError: the first steps show that the budget ends before the first update.
        """
        self.state.samples += self.worlds.count * distributed.processes()
        self._rewards.append(float(transition.reward.mean()))
        if bool(transition.ended.any()):
            self._outcomes.extend(transition.succeeded[transition.ended].tolist())
        seconds = self._steps.seconds(self.log.seconds)
        if seconds is not None:
            self.time.measured(seconds)

    def expect_work(self, pieces: int, work: str, less: str, of_expert: bool) -> None:
        """The first update waits for so many episodes of the expert, or control steps, see `Session.expect`.

        Raises:
            BudgetTooSmallError: the budget ends before.
        """
        kind = {
            "of_expert": of_expert,
            "scene": self.scenes[0].record(),
            "config": asdict(self.config),
            "threads": self.spec.threads,
            "backend": self.spec.asked.backend,
            "device": str(self.worlds.device),
            "processes": distributed.processes(),
        }
        self._steps = StepClock()
        self.expect(FirstUpdate(work, pieces, less, of_expert), kind)

    def report(self, numbers: dict[str, float]) -> None:
        """Log the metrics of an update together with the recent rewards and successes."""
        metrics = {
            "reward": ordered_sum(self._rewards) / max(len(self._rewards), 1),
            **numbers,
        }
        metrics |= {f"holds/{name}": share for name, share in self.worlds.held().items()}
        if self._outcomes:
            metrics["training_success"] = sum(self._outcomes) / len(self._outcomes)
        self.log.report(self.state.updates, self.state.samples, metrics)

    def due(self, every: int, before: int) -> bool:
        """Whether the number of samples has passed a multiple of ``every`` since it was ``before``."""
        # A step takes as many samples as there are worlds, and may jump over the multiple.
        return self.state.samples // every > before // every

    def time_shares(self) -> dict[str, float]:
        """Fractions of the wall time since this process started: env, learner, evaluation, other (acting, files)."""
        parts = {
            "env": self.worlds.seconds,
            "learner": self.learner_seconds,
            "evaluation": self.evaluation_seconds,
        }
        # Clocks of parts may add up to a hair more than the whole.
        total = max(time.perf_counter() - self._began, ordered_sum(parts.values()))
        shares = {name: seconds / total for name, seconds in parts.items()}
        shares["other"] = 1.0 - ordered_sum(shares.values())
        return {name: round(share, 4) for name, share in shares.items()}

    def summarize(self) -> dict[str, Any]:
        """See `Session.summarize`."""
        return {
            **super().summarize(),
            "rounds": 0,
            "demonstrations": self.demonstrations,
            "time_shares": self.time_shares(),
        }
