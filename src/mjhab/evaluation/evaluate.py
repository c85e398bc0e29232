"""Evaluation: run a policy in reproducible episodes and store the results in a run folder.

`evaluate` is `mjhab.evaluate`; ``mjhab eval`` and training call `run_evaluation`. Both do the same.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.config.env_spec import env_names
from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.version import __version__
from mjhab.evaluation.filming import FilmCrew
from mjhab.evaluation.global_random import SeededGlobals
from mjhab.evaluation.own_policy import OwnPolicy
from mjhab.evaluation.resolve import (
    OpenedPolicy,
    PolicyFacts,
    PolicyOptions,
    open_policy,
)
from mjhab.evaluation.specs import EvalSpec, PolicyLike
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
from mjhab.rollout.policy import Clipped, Composed, Paced, Policy, RolloutEnv, Timed
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink
from mjhab.rollout.store import REPORT, EvaluationFolder, StoreSink, read_records
from mjhab.scenes.packs import stage_of
from mjhab.tasks.style import Styles

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv

REQUEST_FACTS = ("latency_ms", "late_steps", "out_of_range")
"""Entries of a summary about the requests of a policy, see `requests_of`."""
FILM_QUALITY = 27
"""x264 constant rate factor. The film of a whole chain takes a few MB, because the report embeds it."""
RECORDED = {
    "task": "task",
    "subtask": "subtask",
    "target": "target",
    "worlds": "num_envs",
    "seed": "seed",
    "split": "split",
    "assets": "assets",
    "episodes_file": "episodes_file",
    "navigate": "navigate",
    "spawns": "spawns",
    "home": "home",
    "threads": "threads",
}
"""Keys of a run's configuration that hold options of the environment, and the fields of `EnvConfig`."""


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
    return run_evaluation(EvalSpec.of(policy=policy, **options))


def run_evaluation(spec: EvalSpec, sinks: Sequence[Sink] = ()) -> Run:
    """Run the missing episodes of an evaluation, and write summary and report.

    Args:
        spec: the evaluation.
        sinks: further listeners of the rollout.

    Raises:
        UsageError: see `evaluate`.
        EvaluationInterrupted: Ctrl-C was pressed; summary and report are written before it is raised.
    """
    opened = open_any(spec.policy)
    facts = opened.facts
    config = resolved_config(spec, facts)
    path = spec.out or default_out(spec, facts.name)
    EvaluationFolder.check(path, config, resume=spec.resume, overwrite=spec.overwrite)
    alone = read_alone(spec.alone)
    if not _anything_left(path, spec):
        with EvaluationFolder.open(path, config, resume=spec.resume) as folder:
            requests = folder.earlier_requests(REQUEST_FACTS)
            return finish(folder, folder.earlier_seconds(), None, alone, requests)
    env = make_env(spec, env_options(spec, facts))
    policy = None
    try:
        with SeededGlobals(spec.asked.seed) as random:
            policy = opened.build(env, policy_options(spec))
            random.take_torch()
            with EvaluationFolder.open(
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
    folder: EvaluationFolder,
    sinks: Sequence[Sink],
    alone: AloneRates | None,
) -> Run:
    started = time.perf_counter()
    earlier = folder.earlier_seconds()
    crew = FilmCrew(*spec.film_px)
    films = FilmSink(range(spec.films), folder.film_path, _open_film, crew=crew)
    interrupted = False
    try:
        rollout(
            env,
            policy,
            folder.missing(spec.episodes),
            spec.asked.seed,
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
        "late_steps": control steps without an action of it, if the world did not wait for it.
        "out_of_range": number of values of its actions that were clipped, by entry of the action.
    """
    parts = policy.acting_policies if isinstance(policy, Composed) else (policy,)
    facts: dict[str, Any] = {}
    timed = [part.latency_ms for part in parts if isinstance(part, Timed)]
    if timed:
        facts["latency_ms"] = _quantiles([value for values in timed for value in values])
    late = [part.late_steps for part in parts if isinstance(part, Paced)]
    counts = [steps for steps in late if steps is not None]
    if counts:
        facts["late_steps"] = int(np.sum(counts))
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


def open_any(policy: PolicyLike) -> OpenedPolicy:
    """Open a policy before its environment is built.

    Raises:
        UsageError: there is no such policy, or it lacks a method.
    """
    return open_policy(policy) if isinstance(policy, str) else OwnPolicy(policy)


def describe_policy(policy: PolicyLike) -> PolicyFacts:
    """Describe a policy before its environment is built.

    Raises:
        UsageError: there is no such policy, or it lacks a method.
    """
    return open_any(policy).facts


def policy_options(spec: EvalSpec) -> PolicyOptions:
    """What an evaluation tells its policy."""
    return PolicyOptions(spec.asked.seed, spec.style, spec.instruction)


def env_options(spec: EvalSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Further environment options: those that the policy needs, overridden by those of the user.

    Raises:
        UsageError: the policy names an option that does not exist, or was trained with another robot than the user's.
    """
    check_env_options(facts.env_options)
    asked = spec.env.get("robot", facts.robot)
    if facts.robot and asked != facts.robot:
        raise wrong_value(
            "robot",
            asked,
            repr(facts.robot),
            f"Leave out --robot, or train a policy with it: mjhab train ALGORITHM --robot {asked}",
            f"policy {facts.name}",
        )
    return {**facts.env_options, **spec.env}


def make_env(spec: EvalSpec, options: Mapping[str, Any]) -> SequentialTaskEnv:
    """Build the environment of an evaluation.

    Args:
        spec: the evaluation; the environment has at most as many worlds as episodes.
        options: further ones, which take precedence, see `env_options`.
    """
    from mjhab.envs import make

    worlds = min(spec.asked.num_envs, spec.episodes)
    asked = {**spec.env_defaults, **spec.env, **options}
    return make(**{**asked, "num_envs": worlds, "autoreset": "disabled"})


def resolved_config(spec: EvalSpec, facts: PolicyFacts) -> dict[str, Any]:
    """Everything that determines the episodes, including the versions of mjhab and MuJoCo, as JSON data."""
    asked = spec.asked
    chosen: dict[str, Any] = {"policy": facts.name, **facts.described}
    chosen |= {key: recorded_value(asked, name) for key, name in RECORDED.items()}
    chosen |= {"episodes": spec.episodes, "films": spec.films}
    if spec.style:
        chosen["style"] = Styles.parse(spec.style).words
    if spec.instruction:
        chosen["instruction"] = spec.instruction
    options = env_options(spec, facts)
    config = EnvConfig(**plain({**spec.env_defaults, **options}))
    chosen |= plain(config.of_profile())
    apart = {"profile", *RECORDED.values()}
    further = {name: value for name, value in options.items() if name not in apart}
    if further:
        chosen["env"] = plain(further)
    if asked.spawns:
        from mjhab.episodes.spawn_sets import SpawnSet

        # The content and hash of the set determine the episodes, not its path.
        chosen["spawns"] = SpawnSet.read(Path(asked.spawns)).describe()
    return {**chosen, "mjhab": __version__, "mujoco": version("mujoco")}


def recorded_value(asked: EnvConfig, name: str) -> Any:
    """The value of an option of the environment as a run's configuration holds it: None for an empty text."""
    value = getattr(asked, name)
    return None if value == "" else value


def default_out(spec: EvalSpec, policy: str) -> Path:
    """Default run folder; ``policy`` is the policy's name."""
    asked = spec.asked
    driven = "drive" if asked.navigate == "drive" and not asked.subtask else None
    words = (asked.task, asked.subtask, asked.target, driven, policy, f"seed{asked.seed}")
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
            raise wrong_value("alone", str(folder), "a folder with runs of --subtask")
        records += found
    return alone_rates(records)


def finish(
    folder: EvaluationFolder,
    seconds: float,
    film_problem: str | None,
    alone: AloneRates | None,
    requests: Mapping[str, Any] | None = None,
) -> Run:
    """Write summary.json and report.html from the records in the folder; ``requests``: see `requests_of`."""
    records = folder.records
    stage = stage_of(folder.config.get("assets") or "builtin")
    summary = {
        "profile": folder.config.get("profile"),
        **stage,
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
            records,
            {**folder.config, **stage},
            seconds,
            folder.film_path,
            film_problem,
            alone,
        )
    )
    return Run(folder.path, folder.config, tuple(records), summary, film_problem)


def check_env_options(options: Mapping[str, Any]) -> None:
    """Refuse environment options of a policy that do not exist, or that an evaluation sets itself.

    Raises:
        UsageError: an option is not allowed.
    """
    valid = set(env_names(EvalSpec).values()) - set(RECORDED.values())
    for name in options:
        if name not in valid:
            raise unknown_name("environment option of a policy", name, sorted(valid))


def _anything_left(path: Path, spec: EvalSpec) -> bool:
    if not spec.resume:
        return True
    done = {record.index for record in read_records(path)}
    return any(index not in done for index in range(spec.episodes))


def _open_film(path: Path, fps: int) -> Film:
    from mjhab.render.film import FilmWriter

    return FilmWriter(path, fps, FILM_QUALITY)
