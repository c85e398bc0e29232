"""Training of an agent by reinforcement learning: open the folder, train, evaluate, write summary and report."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mjhab.learning.checkpoint import restoring
from mjhab.learning.reinforcement import distributed
from mjhab.learning.reinforcement.demonstrations.expert import collect_demonstrations
from mjhab.learning.reinforcement.demonstrations.kept import kept_demonstrations
from mjhab.learning.reinforcement.demonstrations.recorded import replay_recorded
from mjhab.learning.reinforcement.keeping import (
    optimizer_tensors,
    part_of,
    prefixed,
    restore_optimizer,
)
from mjhab.learning.reinforcement.ppo import Ppo, PpoLearner
from mjhab.learning.reinforcement.replay import ReplayBuffer, ReplayShape
from mjhab.learning.reinforcement.running import RunningStatistics
from mjhab.learning.reinforcement.sac import Sac, SacLearner
from mjhab.learning.reinforcement.session import (
    DEMONSTRATIONS,
    REPLAY,
    ReinforcementRequest,
    ReinforcementSession,
    open_reinforcement,
)
from mjhab.learning.runs.report import render_training_report
from mjhab.learning.runs.run import refused_leaves_nothing
from mjhab.learning.runs.session import OutOfTime
from mjhab.learning.runs.train import TrainingResult
from mjhab.learning.students.gaussian import SquashedGaussian
from mjhab.learning.students.student import Student
from mjhab.tasks.subtasks.registry import SUBTASKS, horizons

REPORT_SECONDS = 2.0
"""Time between two reports of SAC, which makes many updates per second [s]."""


def train_reinforcement(
    request: ReinforcementRequest, out: Path, resume: bool = False
) -> TrainingResult:
    """Train an agent, evaluate it, and write everything into the folder ``out``.

    After Ctrl-C the student is the actor of that moment; ``resume`` continues from the last training checkpoint.

    Raises:
        UsageError: folder, scene or checkpoint do not fit.
        BrokenLossError: a loss or a gradient is not finite; the run's student is that of the last checkpoint.
    """
    interrupted = False
    with refused_leaves_nothing(out), open_reinforcement(request, out, resume) as session:
        run: _PpoRun | _SacRun = (
            _PpoRun(session) if session.config.ppo is not None else _SacRun(session)
        )
        try:
            try:
                run.prepare()
                session.check_time()
                if request.round_episodes and not session.standing.evaluated:
                    session.evaluate(run.actor, request.round_episodes)
                run.learn()
            except OutOfTime:
                session.log.show({"phase": "the budget is spent"})
            session.save(run.actor, run.tensors())
            session.keep_best(run.actor)
            # Random weights are not judged.
            if request.eval_episodes and session.standing.trained:
                session.evaluate_student(request.eval_episodes)
        except KeyboardInterrupt:
            session.keep_last(run.actor)
            interrupted = True
        finally:
            summary = summarize(session)
            session.folder.write_summary(summary)
            page = render_training_report(
                session.folder, session.log.rows, session.judged.records, summary
            )
            report = session.folder.write_report(page)
    return TrainingResult(summary, report, interrupted)


def summarize(session: ReinforcementSession) -> dict[str, Any]:
    """Results of a run as JSON data.

    ``split``, ``success_once``, ``interval``, ``success_at_end`` and ``episodes`` come from one evaluation, that of the
    actor after ``evaluated_samples``. ``checkpoint`` is None while there is none; it holds the actor after
    ``student_samples``.
    """
    standing = session.standing
    return {
        "algorithm": session.config.algorithm,
        "preset": session.config.preset,
        "steps": standing.updates,
        "samples": standing.samples,
        "seconds": round(session.log.seconds, 1),
        "cpu_seconds": round(session.log.cpu_seconds, 1),
        "checkpoint": session.folder.kept_student,
        "student_samples": standing.student_samples,
        "trained": standing.trained,
        **session.judged.summary(),
        "rounds": 0,
        "demonstrations": session.demonstrations,
        "time_shares": session.time_shares(),
    }


class _Run(ABC):
    """The part of a training run that both algorithms share."""

    def __init__(self, session: ReinforcementSession) -> None:
        self.session = session
        self.config = session.config

    actor: Student

    @abstractmethod
    def prepare(self) -> None:
        """Make or read the demonstrations and imitate them, if the config asks for it.

        Raises:
            OutOfTime: the budget is spent.
            UsageError: recorded demonstrations do not fit.
        """

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """State that the next update depends on, as named tensors for a checkpoint."""

    @abstractmethod
    def learn(self) -> None:
        """Train until the run's number of samples is reached.

        Raises:
            OutOfTime: the budget is spent.
        """

    def _between(self, before: int) -> None:
        """Write a checkpoint and evaluate if either became due since ``before`` samples."""
        session = self.session
        if session.due(self.config.checkpoint_samples, before):
            session.save(self.actor, self.tensors())
        every = self.config.eval_samples
        if session.request.round_episodes and session.due(every, before):
            session.evaluate(self.actor, session.request.round_episodes)
        session.check_time()

    def _buffer(self, name: str, worlds: int, capacity: int) -> ReplayBuffer:
        seen = self.session.worlds.seen
        images = seen.images.shape[1:]
        steps = max(capacity // worlds, 2)
        reserve = min(self.config.checkpoint_samples // worlds + 2, steps // 4)
        if name == DEMONSTRATIONS:
            reserve = 0
        shape = ReplayShape(
            worlds=worlds,
            steps=steps,
            vector=seen.vector.shape[1],
            images=(int(images[0]), int(images[1]), int(images[2])),
            privileged=seen.privileged.shape[1],
            actions=len(self.session.layout.actions),
        )
        self.session.log.say(f"memory of the buffer {name}: {shape.words}")
        device = self.session.worlds.device
        folder = self.session.folder.path / name if device.type == "cpu" else None
        return ReplayBuffer(shape, device, folder, reserve)

    def _demonstrations(self, episodes: int, style: tuple[str, ...] = ()) -> ReplayBuffer:
        """A buffer of recorded episodes or, without any, of ``episodes`` new episodes of the expert.

        ``style``: of the expert, see `collect_demonstrations`.
        """
        folder = self.session.folder.path / DEMONSTRATIONS

        def fill() -> ReplayBuffer:
            return (
                self._replay_recorded()
                if self.session.request.data
                else self._ask_expert(episodes, style)
            )

        shown = kept_demonstrations(folder, fill)
        self.session.demonstrations = shown.episodes
        return shown

    def _replay_recorded(self) -> ReplayBuffer:
        session = self.session

        def make(worlds: int, steps: int) -> ReplayBuffer:
            return self._buffer(DEMONSTRATIONS, worlds, worlds * steps)

        def tell(done: int, total: int) -> None:
            session.log.show({"phase": f"demonstrations: {done}/{total}"})
            # Several processes have different numbers of batches, and could not decide together.
            if distributed.processes() == 1:
                session.check_time()

        return replay_recorded(session, make, tell)

    def _ask_expert(self, episodes: int, style: tuple[str, ...]) -> ReplayBuffer:
        session = self.session
        subtask = SUBTASKS[session.request.scene.subtask]
        horizon = int(max(*horizons(session.env.task_config), subtask.limits.horizon)) + 2

        def make(worlds: int) -> ReplayBuffer:
            per_world = -(-episodes // worlds) * horizon
            return self._buffer(DEMONSTRATIONS, worlds, worlds * per_world)

        def tell(done: int) -> None:
            session.log.show({"phase": f"demonstrations: {done}/{episodes}"})

        return collect_demonstrations(session, episodes, make, tell, style)


class _PpoRun(_Run):
    """PPO: rollouts and updates in turn."""

    def __init__(self, session: ReinforcementSession) -> None:
        super().__init__(session)
        worlds = session.worlds
        agent = Ppo(
            self.config,
            session.layout,
            session.privileged_width,
            session.request.seed,
            session.start,
        ).to(worlds.device)
        self.actor = agent.actor
        self.agent = agent
        self.learner = PpoLearner(agent, worlds, self.config, session.seed)
        if session.saved is not None:
            with restoring(session.training_file):
                self._restore(session.saved.tensors)

    def prepare(self) -> None:
        session = self.session
        ppo = self.agent.config
        if not ppo.demonstrations:
            return
        self.learner.shown = self._demonstrations(
            ppo.demonstrations, ppo.demonstration_style
        )
        if session.saved is None and session.start is None:
            session.log.show({"phase": "imitation"})
            self.learner.imitate(self._imitated)

    def _imitated(self) -> None:
        """Note one update of the imitation, and end it in time for the evaluations."""
        self.session.standing.trained = True
        self.session.check_time()

    def _restore(self, tensors: Any) -> None:
        learner = self.learner
        self.agent.load_state_dict(part_of("agent", tensors))
        restore_optimizer(learner.optimizer, part_of("optimizer", tensors))
        learner.statistics.restore(part_of("statistics", tensors))
        learner.privileged.restore(part_of("privileged", tensors))
        learner.updates = self.session.standing.updates
        learner.learning_rate = float(tensors["learning_rate"])

    def tensors(self) -> dict[str, Tensor]:
        learner = self.learner
        return {
            "learning_rate": torch.tensor(learner.learning_rate, dtype=torch.float64),
            **prefixed("agent", self.agent.state_dict()),
            **prefixed("optimizer", optimizer_tensors(learner.optimizer)),
            **prefixed("statistics", learner.statistics.tensors()),
            **prefixed("privileged", learner.privileged.tensors()),
        }

    def learn(self) -> None:
        session = self.session
        learner = self.learner
        standing = session.standing
        while standing.samples < self.config.samples:
            before = standing.samples
            began = time.perf_counter()
            rollout, transitions = learner.collect()
            for transition in transitions:
                session.note(transition)
            acted = time.perf_counter()
            numbers = learner.update(rollout, standing.samples / self.config.samples)
            learner.normalize(rollout.seen)
            standing.updates = learner.updates
            standing.trained = True
            ended = time.perf_counter()
            session.learner_seconds += ended - acted
            numbers["loss"] = numbers["value_loss"]
            numbers["samples_per_second"] = (standing.samples - before) / (ended - began)
            numbers["learner_share"] = (ended - acted) / (ended - began)
            session.log.show({"phase": "learning"})
            session.report(numbers)
            self._between(before)


class _SacRun(_Run):
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
            session.request.seed,
            start,
        ).to(worlds.device)
        self.actor = self.agent.actor
        self.learner = SacLearner(self.agent, self.config, session.seed)
        self.owed = 0.0
        """Number of updates that are due; fractions add up."""
        self.online = self._buffer(REPLAY, worlds.count, self.sac.capacity)
        self.shown: ReplayBuffer | None = None
        if session.saved is not None:
            with restoring(session.training_file):
                self._restore(session.saved.tensors)

    def prepare(self) -> None:
        if self.sac.demonstrations:
            self.shown = self._demonstrations(self.sac.demonstrations)

    def _restore(self, tensors: Any) -> None:
        learner = self.learner
        self.agent.load_state_dict(part_of("agent", tensors))
        for name, optimizer in learner.optimizers.items():
            restore_optimizer(optimizer, part_of(f"optimizer_{name}", tensors))
        learner.updates = self.session.standing.updates
        self.owed = float(tensors["owed"])
        if self.session.worlds.device.type == "cpu":
            self.online.position.copy_(tensors["position"])

    def tensors(self) -> dict[str, Tensor]:
        learner = self.learner
        kept = prefixed("agent", self.agent.state_dict())
        for name, optimizer in learner.optimizers.items():
            kept |= prefixed(f"optimizer_{name}", optimizer_tensors(optimizer))
        kept["owed"] = torch.tensor(self.owed, dtype=torch.float64)
        kept["position"] = self.online.position
        return kept

    def learn(self) -> None:
        session = self.session
        standing = session.standing
        worlds = session.worlds
        ratio = self.sac.updates_per_step or 1.0 / worlds.count
        told_at = 0.0
        while standing.samples < self.config.samples:
            before = standing.samples
            began = time.perf_counter()
            self._step()
            acted = time.perf_counter()
            numbers: dict[str, float] = {}
            if standing.samples >= self.sac.warm_up:
                if before < self.sac.warm_up:
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
            if standing.samples >= self.sac.warm_up:
                self._between(before)
            else:
                session.check_time()

    def _step(self) -> None:
        """Take one control step in all worlds and store it in the replay buffer."""
        worlds = self.session.worlds
        seen = worlds.seen
        with torch.no_grad():
            random = self._noise()
            if (
                self.session.standing.samples < self.sac.warm_up
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

    def _noise(self) -> torch.Generator:
        from mjhab.core.seeding import stream

        drawn = stream(self.session.seed, "sac-act", self.session.standing.samples)
        return torch.Generator().manual_seed(int(drawn.integers(1 << 62)))

    def _update(self) -> dict[str, float]:
        standing = self.session.standing
        sac = self.sac
        since = standing.samples - sac.warm_up
        share = max(0.0, 1.0 - since / max(sac.imitation_samples, 1))
        batch = self.learner.batch(self.online, self.shown)
        demonstrated = round(sac.demonstration_share * sac.batch) if self.shown else 0
        frozen = since < sac.frozen_actor_samples
        told = self.learner.update(
            batch, demonstrated, sac.imitation_coefficient * share, frozen
        )
        standing.updates = self.learner.updates
        standing.trained = True
        return told

    def _fit_normalizers(self) -> None:
        """Fit the normalizers once, before the first update; the buffer stores unnormalized observations."""
        agent = self.agent
        if not self.config.inputs.normalize:
            return
        sources = [self.shown] if self.shown is not None else []
        rows = [
            source.draw(self.sac.warm_up // 2, self.learner.random("fit")).seen
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
