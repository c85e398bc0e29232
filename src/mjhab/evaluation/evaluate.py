"""Evaluation: run a policy in reproducible episodes and store the results in a run folder.

`evaluate` is `mjhab.evaluate`; ``mjhab eval`` and training call `run_evaluation`. Both do the same.
"""

from __future__ import annotations

import dataclasses
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from mjhab.config.env import NAVIGATE_MODES, SPLITS, EnvConfig
from mjhab.config.ranges import whole_number
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.typed.options import take_types
from mjhab.core.version import __version__
from mjhab.evaluation.global_random import SeededGlobals
from mjhab.evaluation.own_policy import (
    check_methods,
    check_policy,
    construct_policy,
    env_options_of,
)
from mjhab.evaluation.resolve import (
    PolicyFacts,
    PolicyOptions,
    check_style,
    full_spec,
    inspect_policy,
    no_instruction,
    resolve_policy,
)
from mjhab.reports.metrics import (
    AloneRates,
    alone_rates,
    rows_by_kind,
    rows_by_position,
    summarize,
)
from mjhab.reports.run import render_report
from mjhab.rollout.films import Film, FilmSink
from mjhab.rollout.loop import plain, rollout
from mjhab.rollout.policy import Clipped, Composed, Policy, RolloutEnv, Timed
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
"""A specification for `resolve_policy`, a policy object, or a class or function that makes one."""
Spec = TypeVar("Spec")
"""`EvalSpec`, or another dataclass of options that is used like it."""
REQUEST_FACTS = ("latency_ms", "out_of_range")
"""Entries of a summary about the requests of a policy, see `requests_of`."""
FILM_QUALITY = 27
"""x264 constant rate factor. The film of a whole chain takes a few MB, because the report embeds it."""
NOT_IN_CONFIG = frozenset(
    {"policy", "style", "instruction", "env", "out", "resume", "overwrite", "alone"}
)
"""Fields of `EvalSpec` that a run's configuration stores in another form, or not at all."""
FIXED_ENV_OPTIONS = frozenset(
    {"num_envs", "autoreset", "backend", "device", "starts", "buffers"}
)
"""Environment options that an evaluation sets itself."""


CHECKED_APART = frozenset(
    {"policy", "assets", "episodes", "worlds", "seed", "threads", "films"}
)
"""Fields of `EvalSpec` and `GenerateSpec` whose types other functions check."""


@dataclass(frozen=True)
class EvalSpec:
    """An evaluation: policy, episodes, environment options, and run folder.

    policy: see `PolicyLike`. style: style options of the expert, see `Styles.parse`.
    task: the household task. subtask: evaluate only this subtask, from spawned start states; None evaluates the whole
    task. target: only this object or furniture link of the subtask; None for all. instruction: sentence that the policy
    is told in all episodes of the subtask, in place of their own; None for these.
    episodes: number of episodes, with indices 0 to N-1. worlds: number of parallel worlds. seed: of the run. Seed and
    index determine an episode, so it is the same for every policy. The global generators of Python, numpy and torch
    begin from it, too, for policies that draw from them, and are put back afterwards; what such a policy does depends
    on ``worlds`` and ``resume`` all the same.
    split, home, assets, episodes_file, spawns, navigate, threads: as in `EnvConfig`; None for "".
    env: further fields of `EnvConfig`, e.g. ``{"obs_mode": "depth", "camera_size": 64}``; they take precedence over
    the policy's ``env_options``.
    films: number of episodes to film, from the first on. out: the run folder; None takes `default_out`. resume: run
    only the episodes without a record in ``out``. overwrite: replace an existing run. alone: folders of runs of single
    subtasks, whose success rates give the upper bound of progressive completion.

    Raises:
        UsageError: a name is unknown, a number out of range, or options exclude each other.
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
    instruction: str | None = None
    env: Mapping[str, Any] = field(default_factory=dict)
    out: Path | None = None
    resume: bool = False
    overwrite: bool = False
    alone: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        take_types(self, CHECKED_APART)
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
        check_style(self.policy, self.style)
        if self.target and not self.subtask:
            raise UsageError(
                "a target needs a subtask: a whole task has its targets in its plan."
            )
        if self.instruction and not self.subtask:
            raise UsageError(
                "an instruction needs a subtask: in a whole task every subtask has a sentence of its own."
            )
        for name in ("worlds", "seed", "threads", "films"):
            object.__setattr__(self, name, whole_number(name, getattr(self, name)))
        object.__setattr__(
            self, "episodes", whole_number("episodes", self.episodes, least=1)
        )
        check_env_options(self.env)
        if isinstance(self.policy, str):
            object.__setattr__(
                self,
                "policy",
                full_spec(self.policy, self.task, self.subtask, self.target),
            )


@dataclass(frozen=True)
class Run:
    """Results of an evaluation.

    path: the run folder. config: the resolved configuration, as in config.json. records: of all finished episodes in
    the folder, sorted by index. summary: see `metrics.summarize`. film_problem: why films are missing, or None.
    """

    path: Path
    config: Mapping[str, Any]
    records: tuple[EpisodeRecord, ...]
    summary: Mapping[str, Any]
    film_problem: str | None = None

    @property
    def report(self) -> Path:
        """Path of the HTML report."""
        return self.path / REPORT


class EvaluationInterrupted(KeyboardInterrupt):
    """A `KeyboardInterrupt`, for instance by Ctrl-C, ended an evaluation; ``run`` holds the finished episodes."""

    def __init__(self, run: Run) -> None:
        super().__init__(f"the evaluation in {run.path} was interrupted")
        self.run = run


def evaluate(policy: PolicyLike = "expert", **options: Any) -> Run:
    """Evaluate a policy and write a run folder with records, summary, films and a report, as ``mjhab eval`` does.

    >>> import mjhab
    >>> run = mjhab.evaluate("zero", subtask="close", episodes=1, horizon=5, films=0, out="runs/zero")
    >>> run.summary["episodes"], run.summary["success_once"]
    (1, 0.0)
    >>> run.records[0].subtasks[0].label
    'cant_reach_articulation_failure'

    A policy of one's own is a class: ``mjhab.evaluate(MyPolicy, subtask="pick", obs_mode="depth", out="runs/mine")``.

    Args:
        policy: an object with the `Policy` protocol; a class or function that makes one, from the vector environment if
            it has a parameter; or a name as for ``mjhab eval --policy``, e.g. "expert" or "my_policy.py:MyPolicy".
        **options: fields of `EvalSpec`, and of `EnvConfig` for the environment.

    Returns:
        The run: ``run.summary["success_once"]``, ``run.records``, ``run.report``.

    Raises:
        UsageError: an option is unknown or invalid, or the run folder holds another run.
        EvaluationInterrupted: Ctrl-C was pressed; finished episodes are kept.
    """
    return run_evaluation(spec_of_options(EvalSpec, {"policy": policy, **options}))


def spec_of_options(spec_type: type[Spec], options: Mapping[str, Any]) -> Spec:
    """Build a specification from options that mix its own fields and those of `EnvConfig`.

    Args:
        spec_type: a dataclass with a field ``out`` and a field ``env``, which takes the options that are not its own.
        options: by name; ``out`` may be a string.

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
    """Run the missing episodes of an evaluation, and write summary and report.

    Args:
        spec: the evaluation.
        sinks: further listeners of the rollout.

    Raises:
        UsageError: see `evaluate`.
        EvaluationInterrupted: Ctrl-C was pressed; summary and report are written before it is raised.
    """
    facts = describe_policy(spec.policy)
    config = resolved_config(spec, facts)
    path = spec.out or default_out(spec, facts.name)
    check_folder(path, config, resume=spec.resume, overwrite=spec.overwrite)
    alone = read_alone(spec.alone)
    if not _anything_left(path, spec):
        with RunFolder.open(path, config, resume=spec.resume) as folder:
            requests = folder.earlier_requests(REQUEST_FACTS)
            return finish(folder, folder.earlier_seconds(), None, alone, requests)
    env = make_env(spec, env_options(spec, facts))
    policy = None
    try:
        with SeededGlobals(spec.seed) as random:
            policy = make_policy(spec, env)
            random.take_torch()
            with RunFolder.open(
                path, config, resume=spec.resume, overwrite=spec.overwrite
            ) as folder:
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
            # StoreSink comes last: an episode with a record is complete in all other sinks, too.
            [films, *sinks, StoreSink(folder)],
        )
    except KeyboardInterrupt:
        interrupted = True
    run = finish(
        folder,
        earlier + time.perf_counter() - started,
        films.problem,
        alone,
        requests_of(policy),
    )
    if interrupted:
        raise EvaluationInterrupted(run)
    return run


def close_policy(policy: Policy | None) -> None:
    """Call the policy's method ``close()``, if it has one, to free its resources."""
    close = getattr(policy, "close", None)
    if callable(close):
        close()


def requests_of(policy: Policy) -> dict[str, Any]:
    """What is known of the requests of a policy that is asked elsewhere, as part of a summary; empty for others.

    Returns:
        "latency_ms": median "p50" and 99th percentile "p99" of their duration [ms], both None if none was answered.
        "out_of_range": number of values of its actions that were clipped, by entry of the action.
    """
    parts = policy.acting_policies if isinstance(policy, Composed) else (policy,)
    facts: dict[str, Any] = {}
    timed = [part.latency_ms for part in parts if isinstance(part, Timed)]
    if timed:
        facts["latency_ms"] = _quantiles([value for values in timed for value in values])
    clipped = [part.out_of_range for part in parts if isinstance(part, Clipped)]
    if clipped:
        total: Counter[str] = Counter()
        for counts in clipped:
            total.update(counts)
        facts["out_of_range"] = dict(total)
    return facts


def _quantiles(latency_ms: Sequence[float]) -> dict[str, float | None]:
    if not latency_ms:
        return {"p50": None, "p99": None}
    p50, p99 = np.percentile(latency_ms, [50, 99])
    return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}


def describe_policy(policy: PolicyLike) -> PolicyFacts:
    """Describe a policy before its environment is built.

    Raises:
        UsageError: there is no such policy, or it lacks a method.
    """
    if isinstance(policy, str):
        return inspect_policy(policy)
    called = getattr(policy, "__name__", type(policy).__name__)
    name = getattr(policy, "name", None)
    if not isinstance(name, str):
        # On a class, name may be a property; a function that makes a policy has no name attribute.
        name = called
    if isinstance(policy, type) or not callable(policy):
        check_methods(policy, called)
    return PolicyFacts(name, env_options=env_options_of(policy))


def make_policy(spec: EvalSpec, env: RolloutEnv) -> Policy:
    """Build the policy of an evaluation.

    Raises:
        UsageError: the policy lacks a part of the Policy protocol, or cannot act in this environment.
    """
    policy = spec.policy
    if isinstance(policy, str):
        return resolve_policy(
            policy, env, PolicyOptions(spec.seed, spec.style, spec.instruction or "")
        )
    if spec.instruction:
        raise no_instruction(describe_policy(policy).name)
    if isinstance(policy, type) or not hasattr(policy, "act"):
        return construct_policy(cast(Callable[..., Policy], policy), env)
    check_policy(policy, type(policy).__name__)
    return cast(Policy, policy)


def env_options(spec: EvalSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Further environment options: those that the policy needs, overridden by those of the user.

    Raises:
        UsageError: the policy names an option that does not exist, or was trained with another robot than the user's.
    """
    check_env_options(facts.env_options)
    asked = spec.env.get("robot", facts.robot)
    if facts.robot and asked != facts.robot:
        raise UsageError(
            f"the policy {facts.name} was trained with robot {facts.robot!r}; leave out --robot (got {asked!r}), or "
            f"train a policy with it: mjhab train ALGORITHM --robot {asked}"
        )
    return {**facts.env_options, **spec.env}


def make_env(spec: EvalSpec, options: Mapping[str, Any]) -> SequentialTaskEnv:
    """Build the environment of an evaluation with further ``options``; it has at most as many worlds as episodes."""
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
    """Everything that determines the episodes, including the versions of mjhab and MuJoCo, as JSON data."""
    chosen: dict[str, Any] = {"policy": facts.name, **facts.identity}
    if facts.caution:
        chosen["policy_caution"] = facts.caution
    for f in dataclasses.fields(spec):
        if f.name not in NOT_IN_CONFIG:
            chosen[f.name] = getattr(spec, f.name)
    if spec.style:
        chosen["style"] = Styles.parse(spec.style).words
    if spec.instruction:
        chosen["instruction"] = spec.instruction
    options = env_options(spec, facts)
    config = EnvConfig(task=spec.task, subtask=spec.subtask or "", **plain(options))
    chosen |= plain(config.of_profile())
    further = {name: value for name, value in options.items() if name != "profile"}
    if further:
        chosen["env"] = plain(further)
    if spec.spawns:
        from mjhab.episodes.spawn_sets import SpawnSet

        # The content and hash of the set determine the episodes, not its path.
        chosen["spawns"] = SpawnSet.read(Path(spec.spawns)).describe()
    return {**chosen, "mjhab": __version__, "mujoco": version("mujoco")}


def default_out(spec: EvalSpec, policy: str) -> Path:
    """Default run folder; ``policy`` is the policy's name."""
    driven = "drive" if spec.navigate == "drive" and not spec.subtask else None
    words = (spec.task, spec.subtask, spec.target, driven, policy, f"seed{spec.seed}")
    return Path("runs") / "_".join(
        re.sub(r"[^\w.-]+", "-", word) for word in words if word
    )


def read_alone(folders: Sequence[Path]) -> dict[tuple[str, str], float]:
    """Success rates by (subtask, target kind) from runs of single subtasks.

    Raises:
        UsageError: a folder holds no run of a single subtask.
    """
    records: list[EpisodeRecord] = []
    for folder in folders:
        found = read_records(folder)
        if not any(record.subtask for record in found):
            raise UsageError(
                f"--alone {folder}: this folder holds no run with --subtask."
            )
        records += found
    return alone_rates(records)


def finish(
    folder: RunFolder,
    seconds: float,
    film_problem: str | None,
    alone: AloneRates | None,
    requests: Mapping[str, Any] | None = None,
) -> Run:
    """Write summary.json and report.html from the records in the folder; ``requests``: see `requests_of`."""
    records = folder.records
    summary = {
        "profile": folder.config.get("profile"),
        **summarize(records, seconds, alone),
        **(requests or {}),
    }
    rows = {"along_the_plan": rows_by_position(records), "by_kind": rows_by_kind(records)}
    folder.write_summary(
        {
            **summary,
            **{name: [asdict(row) for row in table] for name, table in rows.items()},
        }
    )
    folder.write_report(
        render_report(
            records, folder.config, seconds, folder.film_path, film_problem, alone
        )
    )
    return Run(folder.path, folder.config, tuple(records), summary, film_problem)


def check_env_options(
    options: Mapping[str, Any], spec: type[Any] = EvalSpec, what: str = "an evaluation"
) -> None:
    """Refuse environment options that do not exist, or for which the specification has a field of its own.

    Args:
        options: by name.
        spec: dataclass of the specification: `EvalSpec`, or one that is converted to it.
        what: name of the specified thing, for the message.

    Raises:
        UsageError: an option is not allowed.
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
