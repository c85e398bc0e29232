"""A run of reinforcement: its worlds, agent, reports and checkpoints. What PPO and SAC have in common."""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mjhab.core.errors import UsageError
from mjhab.core.version import __version__
from mjhab.envs.parts.reporting import CHECKERS
from mjhab.learning.checkpoint import (
    Checkpoint,
    load_checkpoint,
    load_student,
    save_student,
    save_tensors,
)
from mjhab.learning.configs import InputConfig
from mjhab.learning.layout import Layout, layout_of
from mjhab.learning.reinforcement import distributed
from mjhab.learning.reinforcement.configs import ReinforcementConfig
from mjhab.learning.reinforcement.sight import Sight
from mjhab.learning.reinforcement.worlds import TrainingRules, Transition, Worlds
from mjhab.learning.runs.collection import Means, Scene
from mjhab.learning.runs.evaluation import Evaluations
from mjhab.learning.runs.run import TRAINING, Logbook, TrainingFolder
from mjhab.learning.runs.session import FIRST, LATEST, OutOfTime
from mjhab.learning.students.student import Student
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.store import check_folder
from mjhab.tasks.subtasks.registry import SUBTASKS, limits_of

REPLAY = "replay"
DEMONSTRATIONS = "demonstrations"
"""Folders of the buffers of a run."""
RECENT_EPISODES = 200
"""Training episodes that the reported share of successes is taken over."""


@dataclass(frozen=True)
class ReinforcementRequest:
    """What to train, and where.

    start: checkpoint that the actor begins from, "" for none. threads: of physics and networks, 0 for all cores.
    budget_seconds: of wall time for everything, 0 for no limit. eval_episodes: of the last evaluation;
    round_episodes: of those on the way, 0 for none. films: episodes to film in the first and the last evaluation.
    backend, device: of the environment, see `EnvConfig`.
    data, where: shards or folders of them that RLPD takes its demonstrations from, and which episodes of them (those
    that succeed if ""); the expert makes them if there are none. recompute_rewards: also where they were recorded in
    another profile or with other rewards.
    """

    config: ReinforcementConfig
    scene: Scene
    seed: int = 0
    start: str = ""
    threads: int = 0
    budget_seconds: float = 0.0
    eval_episodes: int = 100
    round_episodes: int = 32
    films: int = 0
    backend: str = "cpu"
    device: str = ""
    data: tuple[Path, ...] = ()
    where: str = ""
    recompute_rewards: bool = False


@dataclass
class Standing:
    """How far a run is. checkpoints: how many were written; evaluated: samples made at the evaluations."""

    samples: int = 0
    updates: int = 0
    checkpoints: int = 0
    seconds: float = 0.0
    evaluated: list[int] = field(default_factory=list)


def network_threads(inputs: InputConfig, threads: int) -> int:
    """Threads of the networks: one where they see no images.

    Layers of some hundred rows are over before a second thread is awake, and where other processes want the cores,
    torch's threads wait for each other in loops: a rollout with its update took nine times its CPU time.
    """
    return threads if inputs.cameras else 1


def image_options(inputs: InputConfig) -> dict[str, Any]:
    """Options of an environment that shows the images of ``inputs``; none for the state alone."""
    if not (inputs.image_size and inputs.cameras):
        return {}
    return {"obs_mode": "depth", "cameras": inputs.cameras, "camera_size": inputs.image_size}


def training_env(
    scene: Scene, inputs: InputConfig, worlds: int, threads: int, seed: int, **more: Any
) -> Any:
    """The environment that agents are trained in: dense rewards of at most 1, worlds that are reset by hand."""
    from mjhab.envs import make_train

    options = scene.env_options() | image_options(inputs)
    return make_train(
        **options, num_envs=worlds, threads=threads, seed=seed, autoreset="disabled", **more
    )


class ReinforcementSession:
    """State of a run. Make one with `open_reinforcement`."""

    def __init__(
        self, request: ReinforcementRequest, folder: TrainingFolder, checkpoint: Path, resume: bool
    ) -> None:
        if request.threads:
            torch.set_num_threads(network_threads(request.config.inputs, request.threads))
        self.request = request
        self.folder = folder
        self.start = _start_of(request)
        self.config = request.config
        if self.start is not None:
            self.config = dataclasses.replace(request.config, inputs=self.start.config.inputs)
        # Every process of several draws its own episodes and its own noise.
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
        self.layout = self._layout()
        sight = Sight(self.env, self.layout, self.config.privileged_critic)
        self.privileged_width = sight.privileged_width
        self.scene = dataclasses.replace(request.scene, profile=self.layout.profile)
        self.saved: Checkpoint | None = None
        self.standing = Standing()
        if resume and checkpoint.is_file():
            self.saved = load_checkpoint(checkpoint)
            known = {name: self.saved.about[name] for name in Standing.__dataclass_fields__}
            self.standing = Standing(**known)
        seed = self.seed + self.standing.checkpoints
        self.worlds = Worlds(self.env, sight, seed, self._rules())
        self.log = Logbook(folder, self.standing.seconds, self.standing.updates)
        self.records: list[EpisodeRecord] = []
        self.demonstrations = 0
        """Episodes in the buffer of demonstrations."""
        self._eval_seconds = 0.0
        self._began = time.perf_counter()
        self.learner_seconds = 0.0
        self.evaluation_seconds = 0.0
        """Wall time of updates, and of evaluations, since this start [s]."""
        self._outcomes: deque[bool] = deque(maxlen=RECENT_EPISODES)
        self._rewards: deque[float] = deque(maxlen=100)

    def _rules(self) -> TrainingRules:
        """What ends episodes and costs reward, beside what the environment says."""
        subtask = self.request.scene.subtask
        limits = limits_of(self.env.task_config, subtask)
        conditions = SUBTASKS[subtask].conditions
        return TrainingRules(
            longest_first=limits.horizon if self.config.stagger else 0,
            force_limit=limits.force_limit,
            force_ends=self.config.force_ends,
            force_cost=self.config.force_cost,
            conditions=tuple(name for name in conditions if name in CHECKERS),
        )

    def _episodes(self) -> dict[str, int]:
        """Options of the environment that say which episodes are trained in.

        Navigate keeps its own horizon, which is longer.
        """
        options = {"horizon": self.config.horizon, "episode_pool": self.config.episode_pool}
        if SUBTASKS[self.request.scene.subtask].navigates:
            del options["horizon"]
        return {name: value for name, value in options.items() if value}

    def _layout(self) -> Layout:
        """What the agent sees and does: that of the student it begins from, else that of the environment."""
        if self.start is not None:
            # The student was trained with demonstrations of the same profile; see `Layout.check_env`.
            self.start.layout.check_env(self.env)
            return self.start.layout
        from mjhab.episodes.starts import valid_targets

        target = self.request.scene.target
        targets = (target,) if target else tuple(valid_targets(self.env.config, self.env.layout))
        return layout_of(self.env, self.config.inputs, targets)

    # -- on the way ---------------------------------------------------------------------------------------------------

    def note(self, transition: Transition) -> None:
        """Count a control step of all worlds."""
        self.standing.samples += self.worlds.count * distributed.processes()
        self._rewards.append(float(transition.reward.mean()))
        if bool(transition.ended.any()):
            self._outcomes.extend(transition.succeeded[transition.ended].tolist())

    def report(self, numbers: dict[str, float]) -> None:
        """Tell of an update."""
        told = {"reward": sum(self._rewards) / max(len(self._rewards), 1), **numbers}
        told |= {f"holds/{name}": share for name, share in self.worlds.held().items()}
        if self._outcomes:
            told["training_success"] = sum(self._outcomes) / len(self._outcomes)
        self.log.report(self.standing.updates, self.standing.samples, told)

    def due(self, every: int, before: int) -> bool:
        """Whether a multiple of ``every`` samples was passed since ``before`` samples."""
        return self.standing.samples // every > before // every

    def check_time(self) -> None:
        """End in time for the last evaluation.

        Raises:
            OutOfTime: no more is left of the budget.
        """
        budget = self.request.budget_seconds
        reserve = self._eval_seconds * self.request.eval_episodes
        # The first process judges for all: one that stopped alone would leave the others waiting for its gradients.
        if budget and distributed.told_by_first(self.log.seconds + reserve > budget):
            raise OutOfTime

    # -- checkpoints --------------------------------------------------------------------------------------------------

    def save(self, actor: Student, tensors: dict[str, Tensor]) -> None:
        """Write both checkpoints, and begin new episodes in all worlds.

        A run that goes on from here is then the same as one that was interrupted and resumed.
        """
        if distributed.rank() == 0:
            self._write(actor, tensors)
        self.standing.checkpoints += 1
        self.worlds.begin(self.seed + self.standing.checkpoints)

    def _write(self, actor: Student, tensors: dict[str, Tensor]) -> None:
        self.standing.seconds = self.log.seconds
        about = {
            **vars(self.standing),
            "checkpoints": self.standing.checkpoints + 1,
            "algorithm": self.config.algorithm,
            "preset": self.config.preset,
        }
        save_tensors(self.folder.training, actor, tensors, about)
        self.save_actor(actor)

    def time_shares(self) -> dict[str, float]:
        """Shares of the wall time since this start: environment, updates, evaluations, and the rest (acting, files)."""
        parts = {
            "env": self.worlds.seconds,
            "learner": self.learner_seconds,
            "evaluation": self.evaluation_seconds,
        }
        total = max(time.perf_counter() - self._began, sum(parts.values()))
        shares = {name: seconds / total for name, seconds in parts.items()}
        shares["other"] = 1.0 - sum(shares.values())
        return {name: round(share, 4) for name, share in shares.items()}

    def save_actor(self, actor: Student) -> None:
        """Write the actor as the student that acts."""
        about = {
            "algorithm": self.config.algorithm,
            "step": self.standing.updates,
            "samples": self.standing.samples,
            "scene": vars(self.scene),
            "seed": self.request.seed,
        }
        save_student(self.folder.student, actor, about)

    def evaluate(self, actor: Student, episodes: int, last: bool = False) -> float:
        """Success once of the actor over the episodes 0 to ``episodes`` - 1, as `mjhab eval` has it."""
        if distributed.rank():
            return 0.0
        self.save_actor(actor)
        first = not self.standing.evaluated
        films = self.request.films if first or last else 0
        began = time.perf_counter()

        def tell(done: int) -> None:
            self.log.show({"phase": f"evaluating: {done}/{episodes}"})

        tell(0)
        means = Means(worlds=min(16, self.config.worlds), threads=self.request.threads)
        evaluations = Evaluations(self.scene, means, self.request.seed, tell)
        out = self.folder.evaluation(FIRST if first and not last else LATEST)
        run = evaluations.run(self.folder.student, episodes, films, out)
        self.records = list(run.records)
        spent = time.perf_counter() - began
        self._eval_seconds = spent / episodes
        self.evaluation_seconds += spent
        success = sum(record.success_once for record in self.records) / episodes
        self.standing.evaluated.append(self.standing.samples)
        self.log.report(
            self.standing.updates,
            self.standing.samples,
            {"success_once": success, "evaluated_episodes": episodes},
        )
        return success


def _start_of(request: ReinforcementRequest) -> Student | None:
    """The student that the actor begins from.

    Raises:
        UsageError: the file cannot be read, or is of another kind than the algorithm takes.
    """
    if not request.start:
        return None
    student = load_student(Path(request.start))
    wanted = request.config.student.algorithm
    if student.config.algorithm != wanted or student.config.inputs.history != 1:
        raise UsageError(
            f"{request.config.algorithm} begins from a checkpoint of algorithm {wanted} that sees one observation; "
            f"{request.start} is of {student.config.algorithm} and sees {student.config.inputs.history}."
        )
    student.config = dataclasses.replace(student.config, execute=1)
    return student.requires_grad_(True)


def resolved_config(request: ReinforcementRequest) -> dict[str, Any]:
    """Everything that decides what a run learns, as plain JSON data."""
    return {
        "algorithm": request.config.algorithm,
        "config": asdict(request.config),
        "scene": asdict(request.scene),
        "seed": request.seed,
        "start": request.start,
        "data": [str(path) for path in request.data],
        "where": request.where,
        "recompute_rewards": request.recompute_rewards,
        "backend": request.backend,
        "processes": distributed.processes(),
        "mjhab": __version__,
    }


@contextmanager
def open_reinforcement(
    request: ReinforcementRequest, out: Path, resume: bool = False
) -> Iterator[ReinforcementSession]:
    """A session in the folder ``out``, whose logs are closed in the end.

    Raises:
        UsageError: folder, scene or checkpoint do not fit; nothing was written.
    """
    distributed.join()
    config = resolved_config(request)
    first = distributed.rank() == 0
    mine = out if first else out / f"rank_{distributed.rank()}"
    if not first:
        # The first process refuses a folder that is not empty, so it goes first.
        distributed.wait()
    check_folder(mine, config, resume=resume)
    folder = TrainingFolder.open(mine, config, resume=resume)
    if first:
        distributed.wait()
    session = ReinforcementSession(request, folder, out / TRAINING, resume)
    with session.log:
        yield session
