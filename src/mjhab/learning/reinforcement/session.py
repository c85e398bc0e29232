"""A run of reinforcement learning: environment, logs, evaluations and checkpoints, for both PPO and SAC."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
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
from mjhab.learning.layout import Layout, inputs_of_robot, layout_of
from mjhab.learning.reinforcement import distributed
from mjhab.learning.reinforcement.configs import ONCE, ReinforcementConfig
from mjhab.learning.reinforcement.environments import training_env
from mjhab.learning.reinforcement.sight import Sight
from mjhab.learning.reinforcement.worlds import TrainingRules, Transition, Worlds
from mjhab.learning.runs.collection import Means, Scene
from mjhab.learning.runs.defaults import FILMED_EPISODES
from mjhab.learning.runs.evaluation import (
    EvaluationClock,
    Evaluations,
    Judgement,
    judgement_row,
)
from mjhab.learning.runs.run import TRAINING, Logbook, TrainingFolder
from mjhab.learning.runs.session import FIRST, LATEST, OutOfTime
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.gaussian import gaussian_of
from mjhab.learning.students.heads import check_student
from mjhab.learning.students.student import Student
from mjhab.rollout.store import check_folder
from mjhab.tasks.subtasks.registry import SUBTASKS, limits_of

REPLAY = "replay"
DEMONSTRATIONS = "demonstrations"
"""Folders of a run's replay buffers."""
RECENT_EPISODES = 200
"""Number of most recent training episodes that the reported training success rate covers."""


@dataclass(frozen=True)
class ReinforcementRequest:
    """A training run: agent, scene and resources.

    start: checkpoint to start the actor from, or "". threads: of physics and networks; 0 uses all cores.
    budget_seconds: wall time of the whole run [s], 0 for no limit. eval_episodes: episodes of the final evaluation.
    round_episodes: episodes of the evaluations during training, 0 for none. films: episodes to film in the first and
    the last evaluation. backend, device: of the environment, see `EnvConfig`.
    data: shards, or folders of shards, from which RLPD takes its demonstrations; without any, the scripted expert
    generates them. where: filter on the episodes of ``data``; "" takes the successful ones. recompute_rewards: accept
    episodes that were recorded with another profile or reward; their rewards are computed anew. eval_split: homes of
    the final evaluation, "" for those of the scene, in which those on the way are.

    The cameras that presets name are replaced by those of the scene's robot, see `inputs_of_robot`.

    Raises:
        UsageError: the scene names an unknown robot.
    """

    config: ReinforcementConfig
    scene: Scene
    seed: int = 0
    start: str = ""
    threads: int = 0
    budget_seconds: float = 0.0
    eval_episodes: int = 100
    round_episodes: int = 32
    films: int = FILMED_EPISODES
    backend: str = "cpu"
    device: str = ""
    data: tuple[Path, ...] = ()
    where: str = ""
    recompute_rewards: bool = False
    eval_split: str = ""

    def __post_init__(self) -> None:
        inputs = inputs_of_robot(self.config.inputs, self.scene.robot)
        object.__setattr__(
            self, "config", dataclasses.replace(self.config, inputs=inputs)
        )

    @property
    def judged_split(self) -> str:
        """Split of the homes of the final evaluation."""
        return self.eval_split or self.scene.split


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


class ReinforcementSession:
    """State of a run. Make one with `open_reinforcement`."""

    def __init__(
        self,
        request: ReinforcementRequest,
        folder: TrainingFolder,
        checkpoint: Path,
        resume: bool,
    ) -> None:
        threads = request.config.inputs.network_threads(request.threads)
        if threads:
            torch.set_num_threads(threads)
        self.request = request
        self.folder = folder
        self.training_file = checkpoint
        """The state that the next update depends on, of this process."""
        self.start = _start_of(request)
        self.config = request.config
        if self.start is not None:
            self.config = dataclasses.replace(
                request.config, inputs=self.start.config.inputs
            )
        # Each process draws its own episodes and its own noise.
        self.seed = request.seed + 1_000_003 * distributed.rank()
        self.env = training_env(
            request.scene,
            self.config.inputs,
            self.config.worlds,
            request.threads,
            self.seed,
            backend=request.backend,
            device=request.device,
            **self._episodes(),
        )
        self.saved: Checkpoint | None = None
        self.standing = Standing()
        if resume and checkpoint.is_file():
            self.saved = load_checkpoint(checkpoint)
            self.standing = saved_state(checkpoint, self.saved.about, Standing)
        self.layout = self._layout()
        check_student(self.config.student, self.layout)
        sight = Sight(self.env, self.layout, self.config.privileged_critic)
        self.privileged_width = sight.privileged_width
        self.scene = dataclasses.replace(request.scene, profile=self.layout.profile)
        if self.start is not None:
            self.standing.trained = True
        self.worlds = Worlds(self.env, sight, self._episodes_seed(), self._rules())
        self.log = Logbook(folder, self.standing.seconds, self.standing.updates)
        self.judged = Judgement()
        """The latest evaluation; none after `keep_best` has chosen an actor that was evaluated earlier."""
        self.demonstrations = 0
        """Number of episodes in the demonstration buffer."""
        self._clock = EvaluationClock(request.budget_seconds)
        self._began = time.perf_counter()
        self.learner_seconds = 0.0
        self.evaluation_seconds = 0.0
        """Wall time of the updates and of the evaluations since this process started the run [s]."""
        self._outcomes: deque[bool] = deque(maxlen=RECENT_EPISODES)
        self._rewards: deque[float] = deque(maxlen=100)

    def _rules(self) -> TrainingRules:
        """Rules of training episodes in addition to those of the environment."""
        subtask = self.request.scene.subtask
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
            "stillness": self.request.scene.stillness or self.config.stillness,
        }
        if SUBTASKS[self.request.scene.subtask].navigates:
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
            layout, profile=self.request.scene.profile or layout.profile
        )

    # -- progress -----------------------------------------------------------------------------------------------------

    def note(self, transition: Transition) -> None:
        """Count one control step of all worlds and remember its rewards and finished episodes."""
        self.standing.samples += self.worlds.count * distributed.processes()
        self._rewards.append(float(transition.reward.mean()))
        if bool(transition.ended.any()):
            self._outcomes.extend(transition.succeeded[transition.ended].tolist())

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
        budget = self.request.budget_seconds
        # At the end the last actor may have to be compared with the best one.
        episodes = self.request.eval_episodes + self.request.round_episodes
        reserve = self._clock.reserve(episodes)
        # The first process decides for all: if one process stopped alone, the others would wait for its gradients.
        if budget and distributed.told_by_first(self.log.seconds + reserve > budget):
            raise OutOfTime

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
            "seed": self.request.seed,
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
        episodes = self.request.round_episodes
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
        films = self.request.films if first or last else 0
        began = time.perf_counter()

        def tell(done: int) -> None:
            self.log.show({"phase": f"evaluating: {done}/{episodes}"})

        tell(0)
        means = Means(worlds=min(16, self.config.worlds), threads=self.request.threads)
        # Those on the way choose the best actor: not in the homes that it is judged in.
        split = self.request.judged_split if last else self.scene.split
        judged = dataclasses.replace(self.scene, split=split)
        evaluations = Evaluations(judged, means, self.request.seed, tell)
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


def _start_of(request: ReinforcementRequest) -> Student | None:
    """Load the student that the actor starts from; None if the request names none.

    Raises:
        UsageError: the file cannot be read, or its algorithm does not fit the one to train.
    """
    if not request.start:
        return None
    student = load_student(Path(request.start))
    # Only the first action of a chunk is used; SAC squashes it, so a student of behaviour cloning is converted.
    known = (BC,) if request.config.ppo is not None else (BC, GAUSSIAN, GAUSSIAN_ACTIONS)
    if student.config.algorithm not in known or student.config.inputs.history != 1:
        raise UsageError(
            f"{request.config.algorithm} begins from a checkpoint of algorithm {' or '.join(known)} with a history of "
            f"1; {request.start} has algorithm {student.config.algorithm} and history "
            f"{student.config.inputs.history}."
        )
    if request.config.sac is not None and isinstance(student, BehaviourCloning):
        student = gaussian_of(student)
    student.config = dataclasses.replace(student.config, execute=1)
    return student.requires_grad_(True)


def _check_start(request: ReinforcementRequest) -> None:
    """Refuse a preset that keeps the actor at first, if that actor would be a new one.

    Raises:
        UsageError: names the options that give a trained actor.
    """
    ppo = request.config.ppo
    if (
        ppo is not None
        and ppo.critic_updates
        and not ppo.demonstrations
        and not request.start
    ):
        raise UsageError(
            f"preset {request.config.preset} begins from a trained student: give --start CHECKPOINT, or train from "
            "random weights with --preset scratch."
        )


def resolved_config(request: ReinforcementRequest) -> dict[str, Any]:
    """Everything that determines the result of a run, as JSON data.

    Raises:
        UsageError: the student that the actor starts from cannot be read.
    """
    config = request.config
    if request.start:
        # The network of the preset stays: it is that of the critic.
        config = dataclasses.replace(
            config, inputs=load_student(Path(request.start)).config.inputs
        )
    return {
        "algorithm": config.algorithm,
        "config": asdict(config),
        "scene": asdict(request.scene),
        "seed": request.seed,
        "start": request.start,
        "data": [str(path) for path in request.data],
        "where": request.where,
        "eval_split": request.judged_split,
        "recompute_rewards": request.recompute_rewards,
        "backend": request.backend,
        "processes": distributed.processes(),
        "mjhab": __version__,
    }


@contextmanager
def open_reinforcement(
    request: ReinforcementRequest, out: Path, resume: bool = False
) -> Iterator[ReinforcementSession]:
    """Open a training session in the folder ``out``; its logs are closed on exit.

    Raises:
        UsageError: folder, scene or checkpoint do not fit; then nothing was written.
    """
    distributed.join()
    config = resolved_config(request)
    first = distributed.rank() == 0
    mine = out if first else out / f"rank_{distributed.rank()}"
    if not first:
        # The first process refuses a folder that is not empty, so it goes first.
        distributed.wait()
    check_folder(mine, config, resume=resume, replaceable=False)
    _check_start(request)
    with closing(TrainingFolder.open(mine, config, resume=resume)) as folder:
        if first:
            distributed.wait()
        session = ReinforcementSession(request, folder, out / TRAINING, resume)
        with session.log:
            yield session
