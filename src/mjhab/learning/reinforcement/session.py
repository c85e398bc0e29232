"""A run of reinforcement learning: environment, logs, evaluations and checkpoints, for both PPO and SAC."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.seeding import stream
from mjhab.core.version import __version__
from mjhab.envs.parts.reporting import CHECKERS
from mjhab.learning.checkpoint import (
    Checkpoint,
    load_checkpoint,
    load_student,
    save_student,
    save_tensors,
    saved_state,
)
from mjhab.learning.configs import BC, GAUSSIAN, GAUSSIAN_ACTIONS
from mjhab.learning.layout import Layout, layout_of
from mjhab.learning.reinforcement import distributed
from mjhab.learning.reinforcement.configs import ONCE
from mjhab.learning.reinforcement.environments import training_env
from mjhab.learning.reinforcement.sight import Sight
from mjhab.learning.reinforcement.specs import ReinforcementSpec
from mjhab.learning.reinforcement.worlds import TrainingRules, Transition, Worlds
from mjhab.learning.runs.budget import (
    BudgetTooSmallError,
    FirstUpdate,
    Rates,
    StepClock,
)
from mjhab.learning.runs.evaluation import (
    EvaluationClock,
    Evaluations,
    Judgement,
    judgement_row,
)
from mjhab.learning.runs.run import TRAINING, Logbook, TrainingFolder
from mjhab.learning.runs.session import FIRST, LATEST, OutOfTime
from mjhab.learning.runs.specs import Means
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.gaussian import gaussian_of
from mjhab.learning.students.heads import check_student
from mjhab.learning.students.student import Student
from mjhab.tasks.subtasks.registry import SUBTASKS, limits_of

REPLAY = "replay"
DEMONSTRATIONS = "demonstrations"
"""Folders of a run's replay buffers."""
RECENT_EPISODES = 200
"""Number of most recent training episodes that the reported training success rate covers."""


@dataclass
class Standing:
    """Progress of a run.

    checkpoints: number of checkpoints written. seconds: wall time. evaluated: number of samples at each evaluation.
    best_success, best_samples: success rate of the best evaluation during training, and its number of samples;
    ``keep_best_by`` of the config says which success counts.
    student_samples: number of samples of the actor in the student checkpoint. trained: whether the actor was ever
    updated, or began from a checkpoint.
    """

    samples: int = 0
    updates: int = 0
    checkpoints: int = 0
    seconds: float = 0.0
    evaluated: list[int] = field(default_factory=list)
    best_success: float = -1.0
    best_samples: int = 0
    student_samples: int = 0
    trained: bool = False


@dataclass(frozen=True)
class _Expected:
    """Work that the first update waits for. since: time of the run when it began [s]."""

    needs: FirstUpdate
    rates: Rates
    since: float
    steps: StepClock


class ReinforcementSession:
    """State of a run. Make one with `open_reinforcement`."""

    def __init__(
        self,
        spec: ReinforcementSpec,
        folder: TrainingFolder,
        checkpoint: Path,
    ) -> None:
        threads = spec.config.inputs.network_threads(spec.threads)
        if threads:
            torch.set_num_threads(threads)
        self.spec = spec
        self.folder = folder
        self.training_file = checkpoint
        """The state that the next update depends on, of this process."""
        self.start = _start_of(spec)
        self.config = spec.config
        if self.start is not None:
            self.config = dataclasses.replace(
                spec.config, inputs=self.start.config.inputs
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
        self.saved: Checkpoint | None = None
        self.standing = Standing()
        if spec.resume and checkpoint.is_file():
            self.saved = load_checkpoint(checkpoint)
            self.standing = saved_state(checkpoint, self.saved.about, Standing)
        self.layout = self._layout()
        check_student(self.config.student, self.layout)
        sight = Sight(self.env, self.layout, self.config.privileged_critic)
        self.privileged_width = sight.privileged_width
        self.scene = dataclasses.replace(spec.scene, profile=self.layout.profile)
        if self.start is not None:
            self.standing.trained = True
        self.worlds = Worlds(self.env, sight, self._episodes_seed(), self._rules())
        self.log = Logbook(folder, self.standing.seconds, self.standing.updates)
        self.judged = Judgement()
        """The latest evaluation; none after `keep_best` has chosen an actor that was evaluated earlier."""
        self.demonstrations = 0
        """Number of episodes in the demonstration buffer."""
        self._clock = EvaluationClock(spec.budget_seconds)
        self._began = time.perf_counter()
        self.learner_seconds = 0.0
        self.evaluation_seconds = 0.0
        """Wall time of the updates and of the evaluations since this process started the run [s]."""
        self.shortage = ""
        """What the run needs, if its time budget ends before its first update; "" while it does not."""
        self._expected: _Expected | None = None
        self._outcomes: deque[bool] = deque(maxlen=RECENT_EPISODES)
        self._rewards: deque[float] = deque(maxlen=100)

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
        if SUBTASKS[self.spec.scene.subtask].navigates:
            del options["horizon"]
        return {name: value for name, value in options.items() if value}

    def _layout(self) -> Layout:
        """Observation and action layout: that of the start checkpoint, else derived from the environment."""
        if self.start is not None:
            # The student was trained with demonstrations of the same profile; see `Layout.check_env`.
            self.start.layout.check_env(self.env)
            return self.start.layout
        from mjhab.episodes.starts import aims_of

        targets = aims_of(self.env.config, self.env.layout)
        layout = layout_of(self.env, self.config.inputs, targets)
        if self.saved is not None:
            # An older version began the run with other conventions, perhaps; its weights keep them.
            layout = layout.told_in(self.saved.layout.conventions)
        # Training episodes may be of another stillness, by which the environment's profile is not recognised.
        return dataclasses.replace(
            layout, profile=self.spec.scene.profile or layout.profile
        )

    # -- progress -----------------------------------------------------------------------------------------------------

    def note(self, transition: Transition) -> None:
        """Count one control step of all worlds and remember its rewards and finished episodes."""
        self.standing.samples += self.worlds.count * distributed.processes()
        self._rewards.append(float(transition.reward.mean()))
        if bool(transition.ended.any()):
            self._outcomes.extend(transition.succeeded[transition.ended].tolist())
        if self._expected is not None:
            seconds = self._expected.steps.seconds(self.log.seconds)
            if seconds is not None:
                self.measured(seconds)

    def report(self, numbers: dict[str, float]) -> None:
        """Log the metrics of an update together with the recent rewards and successes."""
        told = {
            "reward": ordered_sum(self._rewards) / max(len(self._rewards), 1),
            **numbers,
        }
        told |= {f"holds/{name}": share for name, share in self.worlds.held().items()}
        if self._outcomes:
            told["training_success"] = sum(self._outcomes) / len(self._outcomes)
        self.log.report(self.standing.updates, self.standing.samples, told)

    def due(self, every: int, before: int) -> bool:
        """Whether the number of samples has passed a multiple of ``every`` since it was ``before``."""
        return self.standing.samples // every > before // every

    def check_time(self) -> None:
        """Check that the time budget still covers the final evaluation.

        Raises:
            OutOfTime: it does not, so training must end now.
        """
        budget = self.spec.budget_seconds
        # At the end the last actor may have to be compared with the best one.
        episodes = self.spec.eval_episodes + self.spec.round_episodes
        reserve = self._clock.reserve(episodes)
        # The first process decides for all: if one process stopped alone, the others would wait for its gradients.
        if budget and distributed.told_by_first(self.log.seconds + reserve > budget):
            raise OutOfTime

    def expect(self, what: str, pieces: int, work: str, less: str) -> None:
        """The first update waits for some work: refuse the budget if it ends before, as far as earlier runs tell.

        Args:
            what: a piece of it: "episode" of the expert, or "step".
            pieces: their number.
            work: all of it, in words.
            less: options of which a new run would need less.

        Raises:
            BudgetTooSmallError: it tells what is needed.
        """
        imitated = self.standing.trained and self.start is None
        self._expected = None
        if not self.spec.budget_seconds or self.standing.updates or imitated:
            return
        episodes = self.spec.eval_episodes + self.spec.round_episodes
        rates = Rates(
            {
                "what": what,
                "scene": asdict(self.scene),
                "config": asdict(self.config),
                "threads": self.spec.threads,
                "backend": self.spec.asked.backend,
                "device": str(self.worlds.device),
                "processes": distributed.processes(),
            }
        )
        needs = FirstUpdate(work, pieces, episodes, less)
        self._expected = _Expected(needs, rates, self.log.seconds, StepClock())
        self._check_expected(rates.seconds)

    def measured(self, seconds: float) -> None:
        """Check the budget again with the measured time of a piece of the expected work [s].

        Raises:
            BudgetTooSmallError: it tells what is needed.
        """
        if self._expected is not None:
            if not distributed.rank():
                self._expected.rates.learn(seconds)
            self._check_expected(seconds)

    def _check_expected(self, seconds: float | None) -> None:
        expected = self._expected
        assert expected is not None
        short = ""
        if seconds is not None:
            episodes = expected.needs.evaluated
            try:
                expected.needs.check(
                    self.spec.budget_seconds,
                    seconds,
                    expected.since,
                    self._clock.needed(episodes),
                    self._clock.reserve(episodes),
                )
            except BudgetTooSmallError as error:
                short = str(error)
        # The first process decides for all, see `check_time`.
        if distributed.told_by_first(bool(short)):
            raise BudgetTooSmallError(short)

    def estimate_evaluation(self, seconds: float) -> None:
        """Take the time that an episode of the expert needs [s] for that of an evaluation, until one is measured."""
        self._clock.guess(seconds)

    # -- checkpoints --------------------------------------------------------------------------------------------------

    def save(self, actor: Student, tensors: dict[str, Tensor]) -> None:
        """Write the training and the student checkpoint, and start new episodes in all worlds.

        The new episodes make an uninterrupted run equal to one that is resumed from this checkpoint.
        """
        if distributed.rank() == 0:
            self._write(actor, tensors)
        self.standing.checkpoints += 1
        self.worlds.begin(self._episodes_seed())

    def _episodes_seed(self) -> int:
        """Seed of the episodes after the latest checkpoint; runs of other seeds have none in common."""
        drawn = stream(self.seed, "episodes", self.standing.checkpoints)
        return int(drawn.integers(1 << 31))

    def _write(self, actor: Student, tensors: dict[str, Tensor]) -> None:
        self.standing.seconds = self.log.seconds
        self.standing.student_samples = self.standing.samples
        about = {
            **vars(self.standing),
            "checkpoints": self.standing.checkpoints + 1,
            "algorithm": self.config.algorithm,
            "preset": self.config.preset,
        }
        save_tensors(self.folder.training, actor, tensors, about)
        self.save_actor(actor)

    def keep_last(self, actor: Student) -> None:
        """Make the actor of this moment the run's student, after Ctrl-C, if it was ever updated.

        The training checkpoint stays that of the last regular one, so a resumed run is exactly repeated from there.
        """
        if self.standing.trained and not distributed.rank():
            self.save_actor(actor)

    def drop_untrained(self) -> None:
        """Delete the student checkpoint if it holds random weights: they are no policy."""
        if not self.standing.trained and not distributed.rank():
            self.folder.student.unlink(missing_ok=True)

    def time_shares(self) -> dict[str, float]:
        """Fractions of the wall time since this process started: env, learner, evaluation, other (acting, files)."""
        parts = {
            "env": self.worlds.seconds,
            "learner": self.learner_seconds,
            "evaluation": self.evaluation_seconds,
        }
        total = max(time.perf_counter() - self._began, ordered_sum(parts.values()))
        shares = {name: seconds / total for name, seconds in parts.items()}
        shares["other"] = 1.0 - ordered_sum(shares.values())
        return {name: round(share, 4) for name, share in shares.items()}

    def save_actor(self, actor: Student, path: Path | None = None) -> None:
        """Write the actor as a student checkpoint, which `mjhab eval` can run; by default as the run's student."""
        about = {
            "algorithm": self.config.algorithm,
            "step": self.standing.updates,
            "samples": self.standing.samples,
            "trained": self.standing.trained,
            "scene": vars(self.scene),
            "seed": self.spec.seed,
        }
        save_student(path or self.folder.student, actor, about)
        if path is None:
            self.standing.student_samples = self.standing.samples

    def keep_best(self, actor: Student) -> None:
        """Make the checkpoint with the best evaluation the run's student; of equal ones the latest.

        The actor at the end of training takes part, too.
        """
        standing = self.standing
        if distributed.rank() or not standing.evaluated:
            return
        episodes = self.spec.round_episodes
        if episodes and standing.evaluated[-1] != standing.samples:
            self.evaluate(actor, episodes)
        if self.folder.best.is_file() and standing.best_samples != standing.samples:
            best = self.folder.best
            write_atomic(self.folder.student, lambda path: shutil.copyfile(best, path))
            standing.student_samples = standing.best_samples
            # It was of the last actor, and the summary tells of the student.
            self.judged = Judgement()

    def evaluate(self, actor: Student, episodes: int) -> None:
        """Evaluate the actor during training, and keep it if no earlier one was better."""
        if distributed.rank():
            return
        self.save_actor(actor)
        standing = self.standing
        success = self._judge(episodes, last=False)
        standing.evaluated.append(standing.samples)
        if success >= standing.best_success:
            standing.best_success = success
            standing.best_samples = standing.samples
            self.save_actor(actor, self.folder.best)

    def evaluate_student(self, episodes: int) -> None:
        """The final evaluation, of the run's student checkpoint."""
        if not distributed.rank():
            self._judge(episodes, last=True)

    def _judge(self, episodes: int, last: bool) -> float:
        """Success rate of the student checkpoint in the episodes 0 to ``episodes`` - 1, as by `mjhab eval`.

        It is success once or at the end, as ``keep_best_by`` of the config says.
        """
        first = not self.standing.evaluated
        films = self.spec.films if first or last else 0
        began = time.perf_counter()

        def tell(done: int) -> None:
            self.log.show({"phase": f"evaluating: {done}/{episodes}"})

        tell(0)
        means = Means(worlds=min(16, self.config.worlds), threads=self.spec.threads)
        # Those on the way choose the best actor: not in the homes that it is judged in.
        split = self.spec.judged_split if last else self.scene.split
        judged = dataclasses.replace(self.scene, split=split)
        evaluations = Evaluations(judged, means, self.spec.seed, tell)
        out = self.folder.evaluation(FIRST if first and not last else LATEST)
        run = evaluations.run(self.folder.student, episodes, films, out)
        self.judged = Judgement(
            split, self.standing.student_samples, {self.scene.name: run.records}
        )
        spent = time.perf_counter() - began
        self._clock.measured(spent / episodes)
        self.evaluation_seconds += spent
        once = sum(record.success_once for record in run.records) / episodes
        at_end = sum(record.success_at_end for record in run.records) / episodes
        self.log.report(
            self.standing.updates,
            self.standing.samples,
            {
                **judgement_row(once, episodes, split, last),
                "success_at_end": at_end,
            },
        )
        return once if self.config.keep_best_by == ONCE else at_end


def _start_of(spec: ReinforcementSpec) -> Student | None:
    """Load the student that the actor starts from; None if the run names none.

    Raises:
        UsageError: the file cannot be read, or its algorithm does not fit the one to train.
    """
    if not spec.start:
        return None
    student = load_student(spec.start)
    # Only the first action of a chunk is used; SAC squashes it, so a student of behaviour cloning is converted.
    known = (BC,) if spec.config.ppo is not None else (BC, GAUSSIAN, GAUSSIAN_ACTIONS)
    if student.config.algorithm not in known or student.config.inputs.history != 1:
        raise UsageError(
            f"{spec.config.algorithm} begins from a checkpoint of algorithm {' or '.join(known)} with a history of "
            f"1; {spec.start} has algorithm {student.config.algorithm} and history "
            f"{student.config.inputs.history}."
        )
    if spec.config.sac is not None and isinstance(student, BehaviourCloning):
        student = gaussian_of(student)
    student.config = dataclasses.replace(student.config, execute=1)
    return student.requires_grad_(True)


def _check_start(spec: ReinforcementSpec) -> None:
    """Refuse a preset that keeps the actor at first, if that actor would be a new one.

    Raises:
        UsageError: names the options that give a trained actor.
    """
    ppo = spec.config.ppo
    if (
        ppo is not None
        and ppo.critic_updates
        and not ppo.demonstrations
        and not spec.start
    ):
        raise UsageError(
            f"preset {spec.config.preset} begins from a trained student: give --start CHECKPOINT, or train from "
            "random weights with --preset scratch."
        )


def resolved_config(spec: ReinforcementSpec) -> dict[str, Any]:
    """Everything that determines the result of a run, as JSON data.

    Raises:
        UsageError: the student that the actor starts from cannot be read.
    """
    config = spec.config
    if spec.start:
        # The network of the preset stays: it is that of the critic.
        config = dataclasses.replace(
            config, inputs=load_student(spec.start).config.inputs
        )
    return {
        "algorithm": config.algorithm,
        "config": asdict(config),
        "scene": asdict(spec.scene),
        "seed": spec.seed,
        "start": str(spec.start or ""),
        "data": [str(path) for path in spec.data],
        "where": spec.where or "",
        "eval_split": spec.judged_split,
        "recompute_rewards": spec.recompute_rewards,
        "backend": spec.asked.backend,
        "processes": distributed.processes(),
        "mjhab": __version__,
    }


@contextmanager
def open_reinforcement(spec: ReinforcementSpec) -> Iterator[ReinforcementSession]:
    """Open a training session in the folder of the run; its logs are closed on exit.

    Raises:
        UsageError: folder, scene or checkpoint do not fit; then nothing was written.
    """
    distributed.join()
    config = resolved_config(spec)
    first = distributed.rank() == 0
    mine = spec.out if first else spec.out / f"rank_{distributed.rank()}"
    if not first:
        # The first process refuses a folder that is not empty, so it goes first.
        distributed.wait()
    TrainingFolder.check(mine, config, resume=spec.resume)
    _check_start(spec)
    with TrainingFolder.open(mine, config, resume=spec.resume) as folder:
        if first:
            distributed.wait()
        session = ReinforcementSession(spec, folder, spec.out / TRAINING)
        with session.log:
            yield session
