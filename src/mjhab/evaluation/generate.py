"""Generation: record the episodes of a policy in a data set until every target has its quota.

`generate` is `mjhab.generate`; ``mjhab generate`` and the bench of experts call `run_generation`. All do the same.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjhab.assets.sources import licence_of
from mjhab.config.env import EnvConfig
from mjhab.core.errors import wrong_value
from mjhab.core.machine import cores
from mjhab.data.record import generation
from mjhab.data.record.job import Job, Standing
from mjhab.data.record.pools import make_pool
from mjhab.data.record.workers import ALL, Stage, WorkerSpec
from mjhab.data.select.until import Until
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import episodes as recorded_episodes
from mjhab.data.store.reading import RecordedEpisode
from mjhab.episodes.starts import valid_targets
from mjhab.evaluation.parts import (
    check_sendable,
    env_options,
    make_env,
    open_any,
    policy_options,
    recorded_value,
)
from mjhab.evaluation.resolve import PolicyFacts
from mjhab.evaluation.specs import GenerateSpec, PolicyLike
from mjhab.rollout.loop import plain
from mjhab.scenes.pack_source import pack_request
from mjhab.tasks.style import Styles
from mjhab.tasks.subtasks.registry import SUBTASKS

RECORDED = {
    "task": "task",
    "subtask": "subtask",
    "target": "target",
    "seed": "seed",
    "split": "split",
    "home": "home",
    "assets": "assets",
    "navigate": "navigate",
}
"""Keys of a data set's configuration that hold options of the environment, and the fields of `EnvConfig`."""
CONTENT = ("keep", "preset", "images", "cameras", "camera_size", "rgb")
"""Fields of `GenerateSpec` that a data set's configuration holds."""


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
            "skipped_homes": dict(done.skipped_homes),
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
    return run_generation(GenerateSpec.of(policy=policy, out=out, **options))


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
    pool = make_pool(spec.workers, spec.ray)
    begun = time.perf_counter()
    standing = generation.generate(job, pool, tell, stopped, spec.resume)
    return GeneratedData(spec.out, job.config, standing, time.perf_counter() - begun)


def make_job(spec: GenerateSpec) -> Job:
    """Convert a specification to the job for the workers.

    Raises:
        UsageError: there is no such policy, it cannot be sent to workers, or its options contradict others.
    """
    opened = open_any(spec.policy)
    opened.check(policy_options(spec.as_evaluation()))
    facts = opened.facts
    # Ray has a pickler of its own, which sends more.
    if spec.workers and not spec.ray:
        check_sendable(spec.policy, facts.name)
    config = resolved_config(spec, facts)
    keep = spec.filter()
    # A worker without an episode would only take memory.
    workers = max(1, min(spec.workers, spec.max_tries))
    # Workers share the cores; each with all of them would slow the others down.
    threads = spec.asked.threads or max(1, cores() // workers)
    shared = dataclasses.replace(spec, env={**spec.env, "threads": threads})
    worker = WorkerSpec(
        build=functools.partial(build_stage, shared),
        seed=spec.asked.seed,
        keep=keep.text if keep else "",
        states=spec.states,
        images=ImageFormat(spec.rgb) if spec.stores_images else None,
        # Workers may have another current directory.
        rest=None if spec.rest is None else spec.rest.resolve(),
    )
    # Episodes of one subtask all last to the horizon, so one per world leaves no world idle. Chains differ in length.
    worlds = spec.asked.num_envs
    chunk = worlds if spec.asked.subtask else 2 * worlds
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


def build_stage(spec: GenerateSpec) -> Stage:
    """Build the environment and the policy of a worker; called in the worker's process."""
    opened = open_any(spec.policy)
    facts = opened.facts
    evaluation = spec.as_evaluation()
    env = make_env(evaluation, recorded_env_options(spec, facts))
    targets = (ALL,)
    asked = spec.asked
    if asked.subtask and not SUBTASKS[asked.subtask].navigates:
        targets = (
            (asked.target,)
            if asked.target
            else tuple(valid_targets(env.config, env.layout))
        )
    policy = opened.build(env, policy_options(evaluation))
    return Stage(
        env,
        policy,
        about_policy(spec, facts),
        targets,
        licence_of(pack_request(asked.assets).place),
    )


def about_policy(spec: GenerateSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Description of the policy in the data set: everything that determines its actions, as JSON data."""
    about: dict[str, Any] = {"name": facts.name, **facts.identity}
    if facts.env_options:
        about["env_options"] = dict(facts.env_options)
    if spec.style:
        about["style"] = Styles.parse(spec.style).words
    # Its actions depend on the seed and nothing else.
    if spec.policy == "random":
        about["seed"] = spec.asked.seed
    return about


def recorded_env_options(spec: GenerateSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Further environment options that the user, the policy, or the images to store require.

    Raises:
        UsageError: the policy names an option that does not exist, or needs other images than those to store.
    """
    needed = env_options(spec.as_evaluation(), facts)
    until = Until.parse(spec.until)
    if spec.asked.subtask and not until.is_whole:
        overrides = {**needed.get("overrides", {}), "hold_steps": until.hold_steps}
        # In place: `env_options` has made the dict for this call.
        needed["overrides"] = overrides
    if not spec.stores_images:
        return needed
    sees = needed.pop("obs_mode", "")
    # The policy's own images and the stored ones come from one drawing.
    modes = [*spec.images.split("+"), *filter(None, sees.split("+"))]
    stored = {
        "obs_mode": "+".join(dict.fromkeys(modes)),
        "cameras": spec.cameras,
        "camera_size": spec.camera_size,
    }
    for name in ("cameras", "camera_size"):
        if sees and name in needed and needed[name] != stored[name]:
            raise wrong_value(
                name,
                stored[name],
                repr(needed[name]),
                "Store what the policy needs, or no images: `mjhab replay --render` renders others later.",
                f"policy {facts.name}",
            )
    return {**needed, **stored}


def resolved_config(spec: GenerateSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Everything that determines the episodes and their stored content, as JSON data.

    Raises:
        UsageError: see `recorded_env_options`; or an environment option has an unknown value or contradicts the
            profile.
    """
    asked = spec.asked
    config = {key: recorded_value(asked, name) for key, name in RECORDED.items()}
    config |= {name: getattr(spec, name) for name in CONTENT}
    config |= {"no_states": not spec.states, "reward": asked.reward_mode}
    # Without a style the key is left out, so that data sets older than styles can be resumed.
    if spec.until:
        config["until"] = Until.parse(spec.until).text
    if spec.style:
        config["style"] = Styles.parse(spec.style).words
    options = {**recorded_env_options(spec, facts), "cameras": spec.cameras}
    config |= EnvConfig(**{**spec.env_defaults, **options}).of_profile()
    apart = {*config, *RECORDED.values(), "num_envs", "threads", "reward_mode"}
    further = {name: value for name, value in spec.env.items() if name not in apart}
    if further:
        config["env"] = further
    return plain({**config, "policy": facts.name, **facts.described})
