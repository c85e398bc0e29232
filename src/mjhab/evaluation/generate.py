"""Generation: record the episodes of a policy in a data set until every target has its quota.

`generate` is `mjhab.generate`; ``mjhab generate`` and the bench of experts call `run_generation`. All do the same.
"""

from __future__ import annotations

import dataclasses
import functools
import pickle
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mjhab.assets.sources import licence_of
from mjhab.config.env import EnvConfig
from mjhab.config.ranges import range_of, whole_number
from mjhab.core.errors import UsageError
from mjhab.core.machine import cores
from mjhab.core.typed.options import take_types
from mjhab.data.record import generation
from mjhab.data.record.crew import ALL, Crew, InlineCrew, ProcessCrew, Stage, WorkerSpec
from mjhab.data.record.generation import Job, Standing
from mjhab.data.select.query import Filter, read_filter
from mjhab.data.select.until import Until
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes as recorded_episodes
from mjhab.data.store.reading import RecordedEpisode
from mjhab.envs.observations.modes import camera_names, image_size, mode_outputs
from mjhab.episodes.starts import valid_targets
from mjhab.evaluation.evaluate import (
    CHECKED_APART,
    EvalSpec,
    PolicyLike,
    check_env_options,
    describe_policy,
    env_options,
    make_env,
    make_policy,
    spec_of_options,
)
from mjhab.evaluation.resolve import PolicyFacts, full_spec
from mjhab.robots.registry import DEFAULT_ROBOT, robot_named
from mjhab.rollout.loop import plain
from mjhab.scenes.pack_source import Assets, pack_request
from mjhab.tasks.style import Styles
from mjhab.tasks.subtasks.registry import SUBTASKS

NO_IMAGES = "none"
TRIES_PER_EPISODE = 20
"""Number of episodes tried per episode to keep, if ``episodes`` is not given."""
MAX_TARGETS = 10
"""Upper bound on the number of object types of a task."""
NOT_IN_CONFIG = frozenset(
    {
        "out",
        "policy",
        "style",
        "env",
        "states",
        "reward_mode",
        "episodes",
        "per_target",
        "per_label",
        "worlds",
        "workers",
        "threads",
        "ray",
        "resume",
        "until",
    }
)
"""Fields of `GenerateSpec` that a data set's configuration stores in another form, or not at all."""


@dataclass(frozen=True)
class GenerateSpec:
    """A data set to generate: policy, episodes, content, and folder.

    out: folder of the shards.
    policy, style, task, subtask, target, seed, split, home, assets: as in `EvalSpec`.
    navigate: as in `EvalSpec`; None lets the policy drive the robot in whole tasks instead of teleporting it.
    until: "success+N" ends an episode of a single subtask N control steps after its first success, or when it exceeds
    the force limit; "" continues to the horizon. Whole tasks end with their success.
    env: further fields of `EnvConfig`, e.g. ``{"profile": "ms_hab"}``; they take precedence over the policy's
    ``env_options``.
    per_target, per_label: number of episodes to keep per target, and per label of a target; 0 for no limit. Whole
    tasks and Navigate count as one target. episodes: number of episodes to try, with indices 0 to N-1; None tries
    TRIES_PER_EPISODE times as many as are to be kept, and needs ``per_target``.
    keep, preset: filter of the episodes to keep, and name of a predefined one (see `query.PRESETS`); an episode must
    pass both. None keeps all.
    states: store positions and velocities; without them images cannot be rendered later. images: camera images to
    store, "depth", "rgb", "rgbd", "seg" or several joined by "+"; "none" for none. cameras: their names, None for all
    cameras of the robot. camera_size: side, or height and width [px]. rgb: format of colour images, "png" or "jpeg".
    reward_mode: reward to store; "" takes that of an evaluation.
    worlds: parallel episodes per worker. workers: number of processes to start (a script then needs
    ``if __name__ == "__main__":``); 0 runs in this process. threads: of the physics in each worker, 0 divides the
    cores among the workers. ray: address of a Ray cluster whose actors are the workers, "local" to start one here.
    None of these four changes the results.
    resume: continue the data set in ``out``; episodes, worlds, workers and threads may differ from before.

    Raises:
        UsageError: a name is unknown, a number out of range, a filter invalid, or options exclude each other.
    """

    out: Path
    policy: PolicyLike = "expert"
    style: tuple[str, ...] = ()
    task: str = "set_table"
    subtask: str | None = None
    target: str | None = None
    seed: int = 0
    split: str = "train"
    home: str | None = None
    assets: Assets = "builtin"
    navigate: str | None = None
    until: str = ""
    env: Mapping[str, Any] = field(default_factory=dict)
    per_target: int = 0
    per_label: int = 0
    episodes: int | None = None
    keep: str | None = None
    preset: str | None = None
    states: bool = True
    images: str = NO_IMAGES
    cameras: tuple[str, ...] | None = None
    camera_size: int | tuple[int, int] = 128
    rgb: str = "png"
    reward_mode: str = ""
    worlds: int = 4
    workers: int = 0
    threads: int = 0
    ray: str | None = None
    resume: bool = False

    def __post_init__(self) -> None:
        take_types(
            self, CHECKED_APART | {"per_target", "per_label", "workers", "camera_size"}
        )
        object.__setattr__(self, "assets", pack_request(self.assets).as_json())
        if isinstance(self.policy, str):
            object.__setattr__(
                self,
                "policy",
                full_spec(self.policy, self.task, self.subtask, self.target),
            )
        if self.navigate is None:
            # A single subtask ignores this option; it keeps the value that older data sets have.
            object.__setattr__(self, "navigate", "teleport" if self.subtask else "drive")
        Until.parse(self.until)
        check_env_options(self.env, GenerateSpec, "a data set")
        robot = robot_named(self.env.get("robot", DEFAULT_ROBOT))
        if self.cameras is None:
            object.__setattr__(self, "cameras", robot.camera_names)
        for name in ("per_target", "per_label", "workers"):
            object.__setattr__(self, name, whole_number(name, getattr(self, name)))
        if self.episodes is None and not self.per_target:
            raise UsageError(
                "the number of episodes is missing: give per_target (episodes to keep per target) or episodes "
                "(episodes to try)."
            )
        if self.episodes is not None:
            object.__setattr__(
                self, "episodes", whole_number("episodes", self.episodes, least=1)
            )
        self.as_evaluation()
        self.filter()
        if self.stores_images:
            ImageFormat(self.rgb)
            mode_outputs(self.images)
            camera_names(robot, self.cameras or ())
            image_size(self.camera_size)

    @property
    def stores_images(self) -> bool:
        """Whether camera images are stored."""
        return self.images != NO_IMAGES

    @property
    def max_tries(self) -> int:
        """Largest number of episodes to try."""
        if self.episodes is not None:
            return self.episodes
        _, most = range_of("episodes")
        return min(most, TRIES_PER_EPISODE * MAX_TARGETS * self.per_target)

    def filter(self) -> Filter | None:
        """The filter of ``keep`` and ``preset``; None keeps every episode."""
        return read_filter(self.keep, self.preset)

    def as_evaluation(self) -> EvalSpec:
        """The `EvalSpec` of the same episodes with the same policy."""
        return EvalSpec(
            policy=self.policy,
            style=self.style,
            task=self.task,
            subtask=self.subtask,
            target=self.target,
            episodes=self.max_tries,
            worlds=self.worlds,
            seed=self.seed,
            split=self.split,
            home=self.home,
            assets=self.assets,
            navigate=self.navigate or "teleport",
            threads=self.threads,
            env=self.env,
        )


@dataclass(frozen=True)
class GeneratedData:
    """A generated data set.

    path: folder of the shards. config: the resolved configuration, as in generation.json. standing: numbers of
    episodes written, tried and kept. seconds: wall time of this run [s].
    """

    path: Path
    config: Mapping[str, Any]
    standing: Standing
    seconds: float

    @property
    def is_short(self) -> bool:
        """Whether fewer episodes were kept than the quotas ask for."""
        return self.standing.kept < self.standing.wanted

    @property
    def summary(self) -> dict[str, Any]:
        """Counts as JSON data; ``written``, ``errors`` (episodes that the policy could not finish) and
        ``episodes_per_hour`` are those of this run, the others totals."""
        done = self.standing
        return {
            "written": done.written,
            "kept": done.kept,
            "labels": dict(done.labels.most_common()),
            "episodes_per_hour": round(done.written / self.seconds * 3600, 1),
            "bytes_per_episode": round(done.bytes / done.kept) if done.kept else 0,
            "tried": done.tried,
            "yield": round(done.passed / done.tried, 4) if done.tried else 0.0,
            "errors": sum(done.errors.values()),
            "seconds": round(self.seconds, 1),
        }

    def episodes(self) -> Iterator[RecordedEpisode]:
        """Read the episodes of the data set, see `mjhab.data.store.places.episodes`."""
        return recorded_episodes(self.path)


def generate(
    policy: PolicyLike = "expert", *, out: Path | str, **options: Any
) -> GeneratedData:
    """Record the episodes of a policy in a folder of shards, as ``mjhab generate`` does.

    >>> import mjhab
    >>> made = mjhab.generate("zero", subtask="close", episodes=1, horizon=5, out="runs/close")
    >>> made.summary["kept"], made.summary["labels"]
    (1, {'cant_reach_articulation_failure': 1})
    >>> episode = next(made.episodes())
    >>> episode.array("actions").shape
    (5, 13)

    Args:
        policy: an object with the `Policy` protocol; a class or function that makes one, from the vector environment if
            it has a parameter; or a name as for ``mjhab generate --policy``, e.g. "expert" or "my_policy.py:MyPolicy".
        out: folder of the shards.
        **options: fields of `GenerateSpec`, and of `EnvConfig` for the environment.

    Returns:
        The data set: ``made.summary``, ``made.episodes()``, ``made.path``.

    Raises:
        UsageError: an option is unknown or invalid, or the folder holds other data.
        StorageError: the disk is full; the same call with ``resume=True`` continues.
        MjhabError: a worker failed.
        KeyboardInterrupt: Ctrl-C was pressed; finished episodes are kept, and ``resume=True`` continues.
    """
    return run_generation(
        spec_of_options(GenerateSpec, {"policy": policy, "out": out, **options})
    )


def run_generation(
    spec: GenerateSpec,
    tell: Callable[[Standing], object] = bool,
    stopped: Callable[[], bool] = bool,
) -> GeneratedData:
    """Record the missing episodes of a data set. The kept episodes depend neither on workers nor on interruptions.

    Args:
        spec: the data set.
        tell: called with the counts whenever they change.
        stopped: called several times per second (with ``workers=0``: between batches of episodes). When it returns
            True the workers stop, finished episodes are kept, and ``standing.complete`` is False.

    Raises:
        UsageError, StorageError, MjhabError: see `generate`.
    """
    job = make_job(spec)
    crew = make_crew(spec.workers, spec.ray)
    begun = time.perf_counter()
    standing = generation.generate(job, crew, tell, stopped, spec.resume)
    return GeneratedData(spec.out, job.config, standing, time.perf_counter() - begun)


def make_job(spec: GenerateSpec) -> Job:
    """Convert a specification to the job for the workers.

    Raises:
        UsageError: there is no such policy, it cannot be sent to workers, or its options contradict others.
    """
    facts = describe_policy(spec.policy)
    if spec.workers and not spec.ray:
        _check_sendable(spec.policy, facts.name)
    config = resolved_config(spec, facts)
    keep = spec.filter()
    # A worker without an episode would only take memory.
    workers = max(1, min(spec.workers, spec.max_tries))
    threads = spec.threads or max(1, cores() // workers)
    worker = WorkerSpec(
        build=functools.partial(build_stage, dataclasses.replace(spec, threads=threads)),
        seed=spec.seed,
        keep=keep.text if keep else "",
        states=spec.states,
        images=ImageFormat(spec.rgb) if spec.stores_images else None,
    )
    # Episodes of one subtask all last to the horizon, so one per world leaves no world idle. Chains differ in length.
    chunk = spec.worlds if spec.subtask else 2 * spec.worlds
    return Job(
        spec=worker,
        config=config,
        out=spec.out,
        episodes=spec.max_tries,
        workers=workers,
        chunk=chunk,
        per_target=spec.per_target,
        per_label=spec.per_label,
    )


def make_crew(workers: int, ray: str | None = None) -> Crew:
    """Make a crew of workers: actors of the Ray cluster at ``ray``, processes, or, for 0 workers, this process.

    Raises:
        UsageError: Ray is not installed, or the cluster cannot be reached.
    """
    if ray:
        from mjhab.data.record.ray_crew import RayCrew

        return RayCrew(ray)
    return ProcessCrew() if workers else InlineCrew()


def build_stage(spec: GenerateSpec) -> Stage:
    """Build the environment and the policy of a worker; called in the worker's process."""
    facts = describe_policy(spec.policy)
    evaluation = spec.as_evaluation()
    env = make_env(evaluation, recorded_env_options(spec, facts))
    targets = (ALL,)
    if spec.subtask and not SUBTASKS[spec.subtask].navigates:
        targets = (
            (spec.target,)
            if spec.target
            else tuple(valid_targets(env.config, env.layout))
        )
    policy = make_policy(evaluation, env)
    return Stage(
        env,
        policy,
        about_policy(spec, facts),
        targets,
        licence_of(pack_request(spec.assets).place),
    )


def about_policy(spec: GenerateSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Description of the policy in the data set: everything that determines its actions, as JSON data."""
    about: dict[str, Any] = {"name": facts.name, **facts.identity}
    if facts.env_options:
        about["env_options"] = dict(facts.env_options)
    if spec.style:
        about["style"] = Styles.parse(spec.style).words
    if spec.policy == "random":
        about["seed"] = spec.seed
    return about


def recorded_env_options(spec: GenerateSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Further environment options that the user, the policy, or the images to store require.

    Raises:
        UsageError: the policy names an option that does not exist, or needs other images than those to store.
    """
    needed = env_options(spec.as_evaluation(), facts)
    until = Until.parse(spec.until)
    if spec.subtask and not until.is_whole:
        overrides = {**needed.get("overrides", {}), "hold_steps": until.hold_steps}
        needed["overrides"] = overrides
    if spec.reward_mode:
        needed["reward_mode"] = spec.reward_mode
    if not spec.stores_images:
        return needed
    sees = needed.pop("obs_mode", "")
    modes = [*spec.images.split("+"), *filter(None, sees.split("+"))]
    stored = {
        "obs_mode": "+".join(dict.fromkeys(modes)),
        "cameras": spec.cameras,
        "camera_size": spec.camera_size,
    }
    for name in ("cameras", "camera_size"):
        if sees and name in needed and needed[name] != stored[name]:
            raise UsageError(
                f"the policy {facts.name} needs images with {name} = {needed[name]!r}, but {stored[name]!r} is to be "
                f"stored. Store what the policy needs, or no images: `mjhab replay --render` renders others later."
            )
    return {**needed, **stored}


def resolved_config(spec: GenerateSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Everything that determines the episodes and their stored content, as JSON data.

    Raises:
        UsageError: see `recorded_env_options`; or an environment option has an unknown value or contradicts the
            profile.
    """
    config = {
        f.name: getattr(spec, f.name)
        for f in dataclasses.fields(spec)
        if f.name not in NOT_IN_CONFIG
    }
    config |= {"no_states": not spec.states, "reward": spec.reward_mode}
    # Without a style the key is left out, so that data sets older than styles can be resumed.
    if spec.until:
        config["until"] = Until.parse(spec.until).text
    if spec.style:
        config["style"] = Styles.parse(spec.style).words
    options = {**recorded_env_options(spec, facts), "cameras": spec.cameras}
    config |= EnvConfig(
        task=spec.task, subtask=spec.subtask or "", **options
    ).of_profile()
    further = {name: value for name, value in spec.env.items() if name not in config}
    if further:
        config["env"] = further
    return plain({**config, "policy": facts.name, **facts.identity})


def _check_sendable(policy: PolicyLike, name: str) -> None:
    """Refuse a policy that cannot be sent to worker processes.

    Raises:
        UsageError: the policy cannot be pickled.
    """
    try:
        pickle.dumps(policy)
    except Exception as error:
        raise UsageError(
            f"the policy {name} cannot be sent to worker processes ({error}); give FILE.py:CLASS or a class at the top "
            "level of a module, or workers=0 to record the episodes in this process."
        ) from error
