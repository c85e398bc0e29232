"""Evaluation: run a policy in episodes that its name, seed and index fix, and keep what happened in a run folder.

`evaluate` is `mjhab.evaluate`; ``mjhab eval`` and training call `run_evaluation`. Both do the same.
"""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from mjhab.config.env import NAVIGATE_MODES, SPLITS, EnvConfig
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.version import __version__
from mjhab.evaluation.own_policy import (
    check_methods,
    check_policy,
    construct_policy,
    env_options_of,
)
from mjhab.evaluation.resolve import (
    PolicyFacts,
    PolicyOptions,
    full_spec,
    inspect_policy,
    resolve_policy,
)
from mjhab.reports.metrics import AloneRates, alone_rates, rows_by_kind, rows_by_position, summarize
from mjhab.reports.run import render_report
from mjhab.rollout.films import Film, FilmSink
from mjhab.rollout.loop import plain, rollout
from mjhab.rollout.policy import Policy, RolloutEnv, Timed
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink
from mjhab.rollout.store import REPORT, RunFolder, StoreSink, check_folder, read_records
from mjhab.scenes.pack_source import Assets, pack_request
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.style import Styles
from mjhab.tasks.subtasks.registry import SUBTASKS

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

PolicyLike = str | Policy | Callable[..., Policy]
"""A specification for `resolve_policy`, a policy, or what makes one: a class or function of the environment or nothing.
"""
Spec = TypeVar("Spec")
"""Specification of an evaluation, or of what is made like one."""
FILM_QUALITY = 27
"""x264 rate factor: a film of a whole chain stays at a few MB, since the report carries it."""
NOT_IN_CONFIG = frozenset({"policy", "style", "env", "out", "resume", "overwrite", "alone"})
"""Fields of `EvalSpec` that a run's configuration holds in another form, or not at all."""
FIXED_ENV_OPTIONS = frozenset({"num_envs", "autoreset", "backend", "device", "starts", "buffers"})
"""Options of the environment that an evaluation sets itself."""


@dataclass(frozen=True)
class EvalSpec:
    """What to evaluate, where, and where the results go.

    policy: see `PolicyLike`. style: how the expert acts, see `Styles.parse`.
    task, subtask, target: the whole task, or one subtask (about one object or link) from spawned starts; None for all.
    episodes: those with index 0 to N-1; the same index is the same episode for every policy. worlds: how many run at
    the same time. seed: of the run; with the index it fixes the episode.
    split, home, assets, episodes_file, spawns, navigate, threads: as in `EnvConfig`; None for "".
    env: further fields of `EnvConfig`, e.g. ``{"obs_mode": "depth", "camera_size": 64}``; they go before what the
    policy asks for by its ``env_options``.
    films: the first N episodes are filmed. out: the run folder; `default_out` names one if None. resume: run what has
    no record there yet. overwrite: start again. alone: folders of runs of single subtasks, whose success rates give
    the upper bound of progressive completion.

    Raises:
        UsageError: an unknown name, a number out of range, or options that exclude each other.
    """

    policy: PolicyLike = "expert"
    task: str = "set_table"
    subtask: str | None = None
    target: str | None = None
    episodes: int = 20
    worlds: int = 8
    seed: int = 0
    split: str = "train"
    assets: Assets = "builtin"
    episodes_file: str | None = None
    navigate: str = "teleport"
    spawns: str | None = None
    home: str | None = None
    threads: int = 0
    films: int = 4
    style: tuple[str, ...] = ()
    env: Mapping[str, Any] = field(default_factory=dict)
    out: Path | None = None
    resume: bool = False
    overwrite: bool = False
    alone: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        TASKS.check(self.task)
        if self.subtask:
            SUBTASKS.check(self.subtask)
        object.__setattr__(self, "assets", pack_request(self.assets).as_json())
        for kind, given, valid in (
            ("split", self.split, SPLITS),
            ("navigate mode", self.navigate, NAVIGATE_MODES),
        ):
            if given is not None and given not in valid:
                raise unknown_name(kind, given, valid)
        if self.style and self.policy != "expert":
            raise UsageError("a style is for the policy expert; other policies have none.")
        Styles.parse(self.style)
        if self.target and not self.subtask:
            raise UsageError("a target needs a subtask: a whole task has its targets in its plan.")
        for name, least in (
            ("episodes", 1),
            ("worlds", 1),
            ("seed", 0),
            ("threads", 0),
            ("films", 0),
        ):
            value = getattr(self, name)
            if value < least:
                raise UsageError(f"{name} must be at least {least}, got {value}.")
        check_env_options(self.env)
        if isinstance(self.policy, str):
            object.__setattr__(
                self, "policy", full_spec(self.policy, self.task, self.subtask, self.target)
            )


@dataclass(frozen=True)
class Run:
    """What an evaluation left.

    path: the run folder. config: what the run resolved to, as in config.json. records: finished episodes, of this
    start and of earlier ones, by index. summary: see `metrics.summarize`. film_problem: why films are missing, or None.
    """

    path: Path
    config: Mapping[str, Any]
    records: tuple[EpisodeRecord, ...]
    summary: Mapping[str, Any]
    film_problem: str | None = None

    @property
    def report(self) -> Path:
        """The page to look at."""
        return self.path / REPORT


class EvaluationInterrupted(KeyboardInterrupt):
    """A `KeyboardInterrupt`, for instance by Ctrl-C, ended an evaluation; ``run`` holds the finished episodes."""

    def __init__(self, run: Run) -> None:
        super().__init__(f"the evaluation in {run.path} was interrupted")
        self.run = run


def evaluate(policy: PolicyLike = "expert", **options: Any) -> Run:
    """Evaluate a policy; leaves a run folder with records, numbers, films and a report, as ``mjhab eval`` does.

    For instance ``mjhab.evaluate(MyPolicy, subtask="pick", episodes=50, obs_mode="depth", out="runs/mine")``.

    Args:
        policy: an object with the `Policy` protocol; a class or function that makes one, from the vector environment if
            it has a parameter; or a name as for ``mjhab eval --policy``, e.g. "expert" or "my_policy.py:MyPolicy".
        **options: fields of `EvalSpec`, and of `EnvConfig` for the environment.

    Returns:
        The run: ``run.summary["success_once"]``, ``run.records``, ``run.report``.

    Raises:
        UsageError: an option is unknown or cannot work, or the run folder holds something else.
        EvaluationInterrupted: Ctrl-C; what was finished is kept.
    """
    return run_evaluation(spec_of_options(EvalSpec, {"policy": policy, **options}))


def spec_of_options(spec_type: type[Spec], options: Mapping[str, Any]) -> Spec:
    """Make a specification of options in which its own fields and those of `EnvConfig` stand side by side.

    Args:
        spec_type: a dataclass with the fields ``env``, for the options that are no field of its own, and ``out``.
        options: by name; ``out`` may be a text.

    Raises:
        UsageError: see the dataclass.
    """
    own = {f.name for f in dataclasses.fields(cast(Any, spec_type))}
    known = {name: value for name, value in options.items() if name in own}
    further = {name: value for name, value in options.items() if name not in own}
    if further:
        known["env"] = {**known.get("env", {}), **further}
    if isinstance(known.get("out"), str):
        known["out"] = Path(known["out"])
    return spec_type(**known)


def run_evaluation(spec: EvalSpec, sinks: Sequence[Sink] = ()) -> Run:
    """Run what is missing of an evaluation, and write summary and report.

    Args:
        spec: what, and where to.
        sinks: further listeners of the rollout.

    Raises:
        UsageError: see `evaluate`.
        EvaluationInterrupted: Ctrl-C; summary and report are written before it is raised.
    """
    facts = describe_policy(spec.policy)
    config = resolved_config(spec, facts)
    path = spec.out or default_out(spec, facts.name)
    check_folder(path, config, resume=spec.resume, overwrite=spec.overwrite)
    alone = read_alone(spec.alone)
    if not _anything_left(path, spec):
        with RunFolder.open(path, config, resume=spec.resume) as folder:
            return finish(folder, folder.earlier_seconds(), None, alone)
    env = make_env(spec, env_options(spec, facts))
    policy = None
    try:
        policy = make_policy(spec, env)
        with RunFolder.open(path, config, resume=spec.resume, overwrite=spec.overwrite) as folder:
            return _run(spec, env, policy, folder, sinks, alone)
    finally:
        close_policy(policy)
        env.close()


def _run(
    spec: EvalSpec,
    env: RolloutEnv,
    policy: Policy,
    folder: RunFolder,
    sinks: Sequence[Sink],
    alone: AloneRates | None,
) -> Run:
    started = time.perf_counter()
    earlier = folder.earlier_seconds()
    films = FilmSink(range(spec.films), folder.film_path, _open_film)
    interrupted = False
    try:
        rollout(
            env,
            policy,
            folder.missing(spec.episodes),
            spec.seed,
            # The record comes last: what has one is finished in all other sinks, too.
            [films, *sinks, StoreSink(folder)],
        )
    except KeyboardInterrupt:
        interrupted = True
    run = finish(
        folder, earlier + time.perf_counter() - started, films.problem, alone, latency(policy)
    )
    if interrupted:
        raise EvaluationInterrupted(run)
    return run


def close_policy(policy: Policy | None) -> None:
    """Let a policy free what it holds, if it has a method for that: ``close``, without arguments."""
    close = getattr(policy, "close", None)
    if callable(close):
        close()


def latency(policy: Policy) -> dict[str, float] | None:
    """Median and 99th percentile of the duration of a policy's requests [ms]; None if it made or measures none."""
    if not isinstance(policy, Timed) or not policy.latency_ms:
        return None
    p50, p99 = np.percentile(policy.latency_ms, [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}


def describe_policy(policy: PolicyLike) -> PolicyFacts:
    """What is known of a policy before its environment is built.

    Raises:
        UsageError: there is no such policy, or it lacks a method.
    """
    if isinstance(policy, str):
        return inspect_policy(policy)
    called = getattr(policy, "__name__", type(policy).__name__)
    name = getattr(policy, "name", None)
    if not isinstance(name, str):
        # On a class it may be a property, and a function that makes a policy has none.
        name = called
    if isinstance(policy, type) or not callable(policy):
        check_methods(policy, called)
    return PolicyFacts(name, env_options=env_options_of(policy))


def make_policy(spec: EvalSpec, env: RolloutEnv) -> Policy:
    """Build the policy of an evaluation.

    Raises:
        UsageError: it lacks a part of the Policy protocol, or cannot act in this environment.
    """
    policy = spec.policy
    if isinstance(policy, str):
        return resolve_policy(policy, env, PolicyOptions(spec.seed, spec.style))
    if isinstance(policy, type) or not hasattr(policy, "act"):
        return construct_policy(cast(Callable[..., Policy], policy), env)
    check_policy(policy, type(policy).__name__)
    return cast(Policy, policy)


def env_options(spec: EvalSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Further options of the environment: what the policy needs, and before that what the user asks for.

    Raises:
        UsageError: the policy asks for an option that does not exist.
    """
    check_env_options(facts.env_options)
    return {**facts.env_options, **spec.env}


def make_env(spec: EvalSpec, options: Mapping[str, Any]) -> SequentialTaskEnv:
    """Build the environment of an evaluation, with further ``options``; no more worlds than episodes."""
    from mjhab.envs import make

    return make(
        **options,
        task=spec.task,
        subtask=spec.subtask or "",
        target=spec.target or "",
        num_envs=min(spec.worlds, spec.episodes),
        split=spec.split,
        assets=spec.assets,
        home=spec.home or "",
        episodes_file=spec.episodes_file or "",
        spawns=spec.spawns or "",
        navigate=spec.navigate,
        seed=spec.seed,
        threads=spec.threads,
        autoreset="disabled",
    )


def resolved_config(spec: EvalSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Everything that decides what happens in the episodes, with the versions that simulate them; plain JSON data."""
    chosen: dict[str, Any] = {"policy": facts.name, **facts.identity}
    for f in dataclasses.fields(spec):
        if f.name not in NOT_IN_CONFIG:
            chosen[f.name] = getattr(spec, f.name)
    if spec.style:
        chosen["style"] = Styles.parse(spec.style).words
    options = env_options(spec, facts)
    config = EnvConfig(task=spec.task, subtask=spec.subtask or "", **plain(options))
    chosen |= plain(config.of_profile())
    further = {name: value for name, value in options.items() if name != "profile"}
    if further:
        chosen["env"] = plain(further)
    if spec.spawns:
        from mjhab.episodes.spawn_sets import SpawnSet

        # A path says little: what the set holds and its hash are what fixes the episodes.
        chosen["spawns"] = SpawnSet.read(Path(spec.spawns)).describe()
    return {**chosen, "mjhab": __version__, "mujoco": version("mujoco")}


def default_out(spec: EvalSpec, policy: str) -> Path:
    """The folder used when none is given. ``policy``: its name."""
    driven = "drive" if spec.navigate == "drive" and not spec.subtask else None
    words = (spec.task, spec.subtask, spec.target, driven, policy, f"seed{spec.seed}")
    return Path("runs") / "_".join(re.sub(r"[^\w.-]+", "-", word) for word in words if word)


def read_alone(folders: Sequence[Path]) -> dict[tuple[str, str], float]:
    """Read the success rates of single-subtask runs.

    Raises:
        UsageError: a folder holds no run, or none of a single subtask.
    """
    records: list[EpisodeRecord] = []
    for folder in folders:
        found = read_records(folder)
        if not any(record.subtask for record in found):
            raise UsageError(f"--alone {folder}: this folder holds no run with --subtask.")
        records += found
    return alone_rates(records)


def finish(
    folder: RunFolder,
    seconds: float,
    film_problem: str | None,
    alone: AloneRates | None,
    latency_ms: Mapping[str, float] | None = None,
) -> Run:
    """Write summary.json and report.html from the records in the folder; ``latency_ms``: see `latency`."""
    records = folder.records
    summary = {"profile": folder.config.get("profile"), **summarize(records, seconds, alone)}
    if latency_ms is not None:
        summary["latency_ms"] = dict(latency_ms)
    rows = {"along_the_plan": rows_by_position(records), "by_kind": rows_by_kind(records)}
    folder.write_summary(
        {**summary, **{name: [asdict(row) for row in table] for name, table in rows.items()}}
    )
    folder.write_report(
        render_report(records, folder.config, seconds, folder.film_path, film_problem, alone)
    )
    return Run(folder.path, folder.config, tuple(records), summary, film_problem)


def check_env_options(
    options: Mapping[str, Any], spec: type[Any] = EvalSpec, what: str = "an evaluation"
) -> None:
    """Refuse options of the environment that do not exist, or that a specification sets by a field of its own.

    Args:
        options: by name.
        spec: dataclass of the specification, `EvalSpec` or one that is turned into it.
        what: what it specifies, for the message.

    Raises:
        UsageError: there is one.
    """
    spec_fields = {f.name for f in dataclasses.fields(spec)}
    evaluated = {f.name for f in dataclasses.fields(EvalSpec)}
    valid = (
        {f.name for f in dataclasses.fields(EnvConfig)}
        - FIXED_ENV_OPTIONS
        - evaluated
        - spec_fields
    )
    for name in options:
        if name not in valid:
            raise unknown_name(f"option of {what}", name, valid | spec_fields - {"env"})


def _anything_left(path: Path, spec: EvalSpec) -> bool:
    if not spec.resume:
        return True
    done = {record.index for record in read_records(path)}
    return any(index not in done for index in range(spec.episodes))


def _open_film(path: Path, fps: int) -> Film:
    from mjhab.render.film import FilmWriter

    return FilmWriter(path, fps, FILM_QUALITY)
