"""Collecting demonstrations: by the expert alone, or by an expert that takes over from a student.

What is collected is an ordinary data set, made by the same code as `mjhab generate`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.config.profiles import DEFAULT_PROFILE, profile_named
from mjhab.core.errors import UsageError
from mjhab.data.record.crew import ALL, Stage, WorkerSpec
from mjhab.data.record.generation import Job, Standing, generate
from mjhab.data.store.images import ImageFormat
from mjhab.evaluation.generate import make_crew
from mjhab.learning.demos import SUCCESSES
from mjhab.learning.runs.take_over import TakeOver
from mjhab.tasks.style import Styles

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv


@dataclass(frozen=True)
class Scene:
    """Where a student learns: options of the environment as on the command line.

    profile, spawn_rule, stillness: as in `EnvConfig`; "" for those of the given data, or the usual ones.
    """

    task: str = "set_table"
    subtask: str = "close"
    target: str = ""
    split: str = "train"
    assets: str | dict[str, Any] = "builtin"
    home: str = ""
    profile: str = ""
    spawn_rule: str = ""
    stillness: str = ""

    def env_options(self) -> dict[str, Any]:
        """Options of `mjhab.envs.make`; what is empty is left to its defaults."""
        return {name: value for name, value in asdict(self).items() if value}

    def apart_from_profile(self) -> dict[str, Any]:
        """Options that are given beside a profile."""
        given = {"spawn_rule": self.spawn_rule, "stillness": self.stillness}
        return {name: value for name, value in given.items() if value}


@dataclass(frozen=True)
class Round:
    """One round of collection.

    number: 0 for the expert alone. student: checkpoint of who begins, None in round 0. longest: see `TakeOver`.
    horizon: control steps of an episode, 0 for those of the task. hold_steps: of those after its outcome, see
    `TaskConfig.hold_steps`. style: of the expert, see `Styles.parse`.
    """

    number: int
    episodes: int
    longest: int = 0
    student: Path | None = None
    horizon: int = 0
    hold_steps: int = -1
    style: tuple[str, ...] = ()


@dataclass(frozen=True)
class Means:
    """What collection and evaluation run on: worlds of a process, processes, threads of each (0 takes all cores).

    Changes the speed, never the results.
    """

    worlds: int = 16
    workers: int = 1
    threads: int = 0


def make_env(
    scene: Scene, view: dict[str, Any], means: Means, collected: Round | None = None
) -> SequentialTaskEnv:
    """The environment of a scene, as a student sees it.

    Args:
        scene: where. means: on what.
        view: see `Layout.env_options`.
        collected: how long episodes last; as in evaluation if None.
    """
    from mjhab.envs import make

    options = {**scene.env_options(), **view}
    if collected is not None:
        options = longer(options, collected.horizon) | {
            "overrides": {"hold_steps": collected.hold_steps}
        }
    return make(**options, num_envs=means.worlds, threads=means.threads, autoreset="disabled")


def longer(options: dict[str, Any], horizon: int) -> dict[str, Any]:
    """Options of an environment whose episodes last ``horizon`` control steps, also where its profile forbids that.

    The environment then has all other values of the profile under the name of the default one; `layout.profile_of`
    tells which it belongs to.
    """
    profile = profile_named(options.get("profile", DEFAULT_PROFILE))
    if not horizon or not profile.binding:
        return {**options, "horizon": horizon}
    values = profile.options(options.get("subtask", ""), trains=False)
    return {**values, **options, "profile": DEFAULT_PROFILE, "horizon": horizon}


class Collector:
    """Makes the data sets of rounds, in this process or by several workers.

    Args:
        scene: where. view: options of the environment that show the student what it sees. means: on what.
        seed: of the run.
        ray: address of a Ray cluster whose actors are the workers; "" for processes of this machine.
    """

    def __init__(
        self, scene: Scene, view: dict[str, Any], means: Means, seed: int, ray: str = ""
    ) -> None:
        self._scene = scene
        self._view = view
        self._means = means
        self._seed = seed
        self._ray = ray
        self._keeper = StageKeeper()

    def collect(
        self,
        wanted: Round,
        out: Path,
        tell: Callable[[Standing], object] = bool,
        stopped: Callable[[], bool] = bool,
    ) -> Standing:
        """Make the data set of a round in a folder, or go on with it; only successes are kept. See `generate`.

        Raises:
            UsageError: the folder holds something else, or no episode succeeded.
            MjhabError: a worker failed, or the disk is full.
        """
        alone = self._means.workers == 1 and not self._ray
        build = self._keeper.stage if alone else build_stage
        images = ImageFormat() if self._view.get("cameras") else None
        spec = WorkerSpec(
            functools.partial(build, self._scene, self._view, self._means, wanted),
            round_seed(self._seed, wanted.number),
            SUCCESSES,
            True,
            images,
        )
        told = {**asdict(wanted), "student": wanted.student.name if wanted.student else ""}
        config = {"scene": asdict(self._scene), "seed": self._seed, "round": told}
        job = Job(spec, config, out, wanted.episodes, self._means.workers, self._means.worlds)
        crew = make_crew(0 if alone else self._means.workers, self._ray)
        standing = generate(job, crew, tell, stopped, resume=True)
        if standing.complete and not standing.kept:
            raise UsageError(
                f"not one of the {standing.tried} episodes of round {wanted.number} succeeded; is the task too hard "
                "for the expert here? See: mjhab eval --policy expert"
            )
        return standing


def round_seed(seed: int, number: int) -> int:
    """Seed of the episodes of a round: other ones in every round."""
    return 1000 * seed + number


def build_stage(scene: Scene, view: dict[str, Any], means: Means, collected: Round) -> Stage:
    """What a worker acts in; called in the worker's process."""
    import torch

    torch.set_num_threads(max(1, means.threads))
    env = make_env(scene, view, means, collected)
    return stage_in(env, collected)


def stage_in(env: SequentialTaskEnv, collected: Round) -> Stage:
    """The stage of a round in an environment."""
    from mjhab.experts import make_expert

    student = None
    about: dict[str, Any] = {"name": TakeOver.name, "longest_prefix": collected.longest}
    if collected.student is not None:
        from mjhab.learning.checkpoint import load_student
        from mjhab.learning.policy import StudentPolicy
        from mjhab.learning.policy_kind import inspect_policy

        student = StudentPolicy(load_student(collected.student), env)
        about |= inspect_policy(str(collected.student)).identity
    styles = Styles.parse(collected.style)
    if collected.style:
        about["style"] = styles.words
    return Stage(env, TakeOver(student, make_expert(env, styles), collected.longest), about, (ALL,))


class StageKeeper:
    """Makes the stages of rounds one after another in this process, all in the same environment."""

    def __init__(self) -> None:
        self._env: SequentialTaskEnv | None = None
        self._made_of: Any = None

    def stage(self, scene: Scene, view: dict[str, Any], means: Means, collected: Round) -> Stage:
        """The stage of a round."""
        made_of = (
            scene,
            tuple(sorted(view.items())),
            means,
            collected.horizon,
            collected.hold_steps,
        )
        if self._env is None or self._made_of != made_of:
            self._env = make_env(scene, view, means, collected)
            self._made_of = made_of
        return stage_in(self._env, collected)
