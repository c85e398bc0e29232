"""A training run of SAC."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from mjhab.learning.checkpoint import part_of, prefixed, restoring
from mjhab.learning.devices import generator
from mjhab.learning.reinforcement.algorithm import AlgorithmRun
from mjhab.learning.reinforcement.keeping import optimizer_tensors, restore_optimizer
from mjhab.learning.reinforcement.replay import ReplayBuffer
from mjhab.learning.reinforcement.running import RunningStatistics
from mjhab.learning.reinforcement.sac.agent import Sac
from mjhab.learning.reinforcement.sac.learner import SacLearner
from mjhab.learning.reinforcement.session import REPLAY, ReinforcementSession
from mjhab.learning.runs import distributed
from mjhab.learning.students.gaussian import SquashedGaussian

REPORT_SECONDS = 2.0
"""Time between two reports of SAC, which makes many updates per second [s]."""


class SacRun(AlgorithmRun):
    """SAC and RLPD: one control step of all worlds and some updates in turn."""

    def __init__(self, session: ReinforcementSession) -> None:
        super().__init__(session)
        assert self.config.sac is not None
        self.sac = self.config.sac
        worlds = session.worlds
        start = session.start
        assert start is None or isinstance(start, SquashedGaussian)
        self.agent = Sac(
            self.config,
            session.layout,
            session.privileged_width,
            session.spec.seed,
            start,
        ).to(worlds.device)
        self.actor = self.agent.actor
        self.learner = SacLearner(self.agent, self.config, session.seed)
        self.owed = 0.0
        """Number of updates that are due; fractions add up."""
        # A transition of the buffer takes two control steps.
        least = 2 * worlds.count * distributed.processes()
        self.warm_up = max(self.sac.warm_up, least)
        """Number of samples before the first update."""
        self.first_update = self.warm_up
        """Number of samples at which updates begin, or go on after a start whose buffer is gone."""
        self.online = self.buffer(REPLAY, worlds.count, self.sac.capacity)
        self.shown: ReplayBuffer | None = None
        if session.saved is not None:
            with restoring(session.training_file):
                self._restore(session.saved.tensors)

    def prepare(self) -> None:
        if self.sac.demonstrations:
            self.shown = self.demonstrations(self.sac.demonstrations)

    def _restore(self, tensors: Any) -> None:
        learner = self.learner
        self.agent.load_state_dict(part_of("agent", tensors))
        for name, optimizer in learner.optimizers.items():
            restore_optimizer(optimizer, part_of(f"optimizer_{name}", tensors))
        learner.updates = self.session.state.updates
        self.owed = float(tensors["owed"])
        # Of all processes, since one of them writes the checkpoint.
        position = tensors["position"].chunk(distributed.processes())[distributed.rank()]
        if not self.online.is_new:
            self.online.position.copy_(position)
        # On a GPU the buffer is memory, and its content ended with the process.
        elif bool(position.any()):
            self.first_update = self.session.state.samples + self.warm_up
            self.session.log.say(
                f"the replay buffer of the earlier start is gone; {self.warm_up:,} samples fill it again before the "
                "next update"
            )

    def save(self) -> None:
        # The worlds start new episodes, whose observations do not follow the steps stored so far.
        self.online.cut(self.session.worlds.seen)
        super().save()

    def tensors(self) -> dict[str, Tensor]:
        learner = self.learner
        kept = prefixed("agent", self.agent.state_dict())
        for name, optimizer in learner.optimizers.items():
            kept |= prefixed(f"optimizer_{name}", optimizer_tensors(optimizer))
        kept["owed"] = torch.tensor(self.owed, dtype=torch.float64)
        # Episodes of other processes end at other steps.
        kept["position"] = distributed.gathered(self.online.position)
        return kept

    def learn(self) -> None:
        session = self.session
        state = session.state
        worlds = session.worlds
        # 0 stands for MS-HAB's rule: one update per step of all worlds.
        ratio = self.sac.updates_per_step or 1.0 / worlds.count
        told_at = 0.0
        left = self.first_update - state.samples
        self.expect_steps(-(-left // (worlds.count * distributed.processes())))
        while state.samples < self.config.samples:
            before = state.samples
            began = time.perf_counter()
            self._step()
            acted = time.perf_counter()
            numbers: dict[str, float] = {}
            if state.samples >= self.first_update:
                # Once: under other statistics the critics' weights would mean something else.
                if before < self.first_update and not self.learner.updates:
                    self._fit_normalizers()
                self.owed += ratio * worlds.count
                while self.owed >= 1.0:
                    numbers |= self._update()
                    self.owed -= 1.0
            ended = time.perf_counter()
            session.learner_seconds += ended - acted
            if numbers and ended - told_at > REPORT_SECONDS:
                told_at = ended
                numbers["loss"] = numbers["critic_loss"]
                numbers["samples_per_second"] = worlds.count / (ended - began)
                numbers["learner_share"] = (ended - acted) / (ended - began)
                session.log.show({"phase": "learning"})
                session.report(numbers)
            # Before it the actor is random and its evaluation worth nothing.
            if state.samples >= self.sac.warm_up:
                self.between(before)
            else:
                session.check_time()

    def _step(self) -> None:
        """Take one control step in all worlds and store it in the replay buffer."""
        worlds = self.session.worlds
        seen = worlds.seen
        with torch.no_grad():
            # By the number of samples, which a checkpoint holds.
            samples = self.session.state.samples
            random = generator(self.session.seed, "sac-act", samples)
            if (
                self.session.state.samples < self.sac.warm_up
                and self.session.start is None
            ):
                shape = (worlds.count, len(self.session.layout.actions))
                actions = (
                    2.0 * torch.rand(shape, generator=random).to(worlds.device) - 1.0
                )
            else:
                features = self.agent.actor.features(seen.vector, seen.images)
                actions, _ = self.agent.actor.sample(features, random)
        transition = worlds.step(actions)
        self.online.add(seen, actions, transition.reward, transition.terminated)
        ended = torch.nonzero(transition.ended).flatten()
        if len(ended):
            self.online.close(ended, transition.next_seen.rows(ended))
        self.session.note(transition)

    def _update(self) -> dict[str, float]:
        state = self.session.state
        sac = self.sac
        since = state.samples - sac.warm_up
        share = max(0.0, 1.0 - since / max(sac.imitation_samples, 1))
        batch = self.learner.batch(self.online, self.shown)
        demonstrated = round(sac.demonstration_share * sac.batch) if self.shown else 0
        frozen = since < sac.frozen_actor_samples
        measured = self.learner.update(
            batch, demonstrated, sac.imitation_coefficient * share, frozen
        )
        state.updates = self.learner.updates
        state.trained = True
        return measured

    def _fit_normalizers(self) -> None:
        """Fit the normalizers once, before the first update; the buffer stores unnormalized observations."""
        agent = self.agent
        if not self.config.inputs.normalize:
            return
        sources = [self.shown] if self.shown is not None else []
        rows = [
            # As many of each source, as batches have later.
            source.draw(self.warm_up // 2, self.learner.random("fit")).seen
            for source in [*sources, self.online]
        ]
        device = self.session.worlds.device
        layout = self.session.layout
        vector = torch.cat([seen.vector for seen in rows])
        statistics = RunningStatistics(layout.width, device)
        statistics.add(vector[:, -layout.width :])
        encoders = [agent.judge.encoder.normalizer, agent.target.encoder.normalizer]
        if self.session.start is None:
            encoders.append(agent.actor.normalizer)
        elif self.sac.share_encoder:
            # The trained actor's inputs keep their meaning, and the critics read the same encoder.
            encoders = []
        if encoders:
            statistics.fit(encoders, layout.measured_width)
        privileged = torch.cat([seen.privileged for seen in rows])
        critics = [agent.judge.critics.privileged, agent.target.critics.privileged]
        if privileged.shape[1]:
            statistics = RunningStatistics(privileged.shape[1], device)
            statistics.add(privileged)
            statistics.fit(critics, privileged.shape[1])
        for part in [*encoders, *critics]:
            distributed.average([part.mean, part.scale])
