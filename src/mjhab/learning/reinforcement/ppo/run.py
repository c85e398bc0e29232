"""A training run of PPO."""

from __future__ import annotations

import time
from typing import Any, cast

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from mjhab.learning.checkpoint import part_of, prefixed, restoring
from mjhab.learning.devices import CPU
from mjhab.learning.reinforcement.algorithm import AlgorithmRun
from mjhab.learning.reinforcement.keeping import optimizer_tensors, restore_optimizer
from mjhab.learning.reinforcement.ppo.agent import Ppo
from mjhab.learning.reinforcement.ppo.learner import PpoLearner
from mjhab.learning.reinforcement.session import ReinforcementSession
from mjhab.learning.students.student import Student


class PpoRun(AlgorithmRun):
    """PPO: rollouts and updates in turn."""

    def __init__(self, session: ReinforcementSession) -> None:
        super().__init__(session)
        worlds = session.worlds
        agent = Ppo(
            self.config,
            session.layout,
            session.privileged_width,
            session.spec.seed,
            session.start,
        ).to(worlds.device)
        self.agent = agent
        decay = agent.config.average
        self.average = AveragedModel(
            # Buffers are the normalizers' statistics, which are averages already.
            agent.actor,
            multi_avg_fn=get_ema_multi_avg_fn(decay),
            use_buffers=False,
        )
        averaged = cast("Student", self.average.module)
        self.actor = averaged if decay else agent.actor
        threads = session.spec.threads if worlds.device.type == CPU else 1
        if threads > 1:
            # Half of them for each of the two networks, which learn at the same time.
            torch.set_num_threads(max(1, torch.get_num_threads() // 2))
        self.learner = PpoLearner(
            agent, worlds, self.config, session.seed, threads=threads
        )
        if session.saved is not None:
            with restoring(session.training_file):
                self._restore(session.saved.tensors)

    def prepare(self) -> None:
        session = self.session
        ppo = self.agent.config
        if not ppo.demonstrations:
            return
        self.learner.shown = self.demonstrations(
            ppo.demonstrations, ppo.demonstration_style
        )
        # A resumed or given actor has learned more than imitation would leave it.
        if session.saved is None and session.start is None:
            session.log.show({"phase": "imitation"})
            self.learner.imitate(self._imitated)
            # What is evaluated before the first update is what has imitated.
            self.average.module.load_state_dict(self.agent.actor.state_dict())

    def _imitated(self) -> None:
        """Note one update of the imitation, and end it in time for the evaluations."""
        self.session.state.trained = True
        self.session.check_time()

    def _restore(self, tensors: Any) -> None:
        learner = self.learner
        self.agent.load_state_dict(part_of("agent", tensors))
        if self.agent.config.average:
            self.average.load_state_dict(part_of("average", tensors))
        restore_optimizer(learner.optimizer, part_of("optimizer", tensors))
        learner.statistics.restore(part_of("statistics", tensors))
        learner.privileged.restore(part_of("privileged", tensors))
        learner.updates = self.session.state.updates
        learner.learning_rate = float(tensors["learning_rate"])

    def tensors(self) -> dict[str, Tensor]:
        learner = self.learner
        averaged = self.average.state_dict() if self.agent.config.average else {}
        return {
            **prefixed("average", averaged),
            # float64, so that a resumed run goes on with the same bits.
            "learning_rate": torch.tensor(learner.learning_rate, dtype=torch.float64),
            **prefixed("agent", self.agent.state_dict()),
            **prefixed("optimizer", optimizer_tensors(learner.optimizer)),
            **prefixed("statistics", learner.statistics.tensors()),
            **prefixed("privileged", learner.privileged.tensors()),
        }

    def learn(self) -> None:
        session = self.session
        learner = self.learner
        state = session.state
        self.expect_steps(learner.config.rollout_steps)
        while state.samples < self.config.samples:
            before = state.samples
            began = time.perf_counter()
            rollout = learner.collect(session.note)
            acted = time.perf_counter()
            numbers = learner.update(rollout, state.samples / self.config.samples)
            # After the update: the rollout's log-probabilities are under the statistics it was acted with.
            learner.normalize(rollout.seen)
            if self.agent.config.average:
                self.average.update_parameters(self.agent.actor)
            state.updates = learner.updates
            state.trained = True
            ended = time.perf_counter()
            session.learner_seconds += ended - acted
            numbers["loss"] = numbers["value_loss"]
            numbers["samples_per_second"] = (state.samples - before) / (ended - began)
            numbers["learner_share"] = (ended - acted) / (ended - began)
            session.log.show({"phase": "learning"})
            session.report(numbers)
            self.between(before)
