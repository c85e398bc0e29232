"""Evaluation: run a policy in reproducible episodes and store the results in a run folder.

`evaluate` is `mjhab.evaluate`; ``mjhab eval`` and training call `run_evaluation`. Both do the same.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.config.env import EnvConfig
from mjhab.core.errors import wrong_value
from mjhab.core.version import __version__
from mjhab.evaluation.global_random import SeededGlobals
from mjhab.evaluation.parts import (
    RECORDED,
    check_sendable,
    close_policy,
    env_options,
    make_env,
    open_any,
    policy_options,
    recorded_value,
    requests_of,
)
from mjhab.evaluation.resolve import (
    PolicyFacts,
)
from mjhab.evaluation.specs import EvalSpec, PolicyLike
from mjhab.evaluation.spread import SpreadRollout, film_sink
from mjhab.reports.metrics import (
    AloneRates,
    alone_rates,
    rows_by_kind,
    rows_by_position,
    summarize,
)
from mjhab.reports.run import render_report
from mjhab.rollout.loop import plain, rollout
from mjhab.rollout.policy import Policy, RolloutEnv
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink
from mjhab.rollout.store import REPORT, EvaluationFolder, StoreSink, read_records
from mjhab.scenes.packs import stage_of
from mjhab.tasks.style import Styles

if TYPE_CHECKING:
    pass

REQUEST_FACTS = ("latency_ms", "late_steps", "out_of_range")
"""Entries of a summary about the requests of a policy, see `requests_of`."""


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
    opened.check(policy_options(spec))
    facts = opened.facts
    config = resolved_config(spec, facts)
    path = spec.out or default_out(spec, facts.name)
    # Before the environment is made, which takes seconds; `open` below does it again under the lock.
    EvaluationFolder.check(path, config, resume=spec.resume, overwrite=spec.overwrite)
    alone = read_alone(spec.alone)
    # A finished run gets its report again without an environment, which takes seconds to make.
    if not _anything_left(path, spec):
        with EvaluationFolder.open(path, config, resume=spec.resume) as folder:
            requests = folder.earlier_requests(REQUEST_FACTS)
            return finish(folder, folder.earlier_seconds(), None, alone, requests)
    if spec.workers or spec.ray:
        check_sendable(spec.policy, facts.name)
        with EvaluationFolder.open(
            path, config, resume=spec.resume, overwrite=spec.overwrite
        ) as folder:
            return _conclude(SpreadRollout(spec, folder, sinks), folder, alone)
    env = make_env(spec, env_options(spec, facts))
    policy = None
    try:
        # Policies of users draw from the global generators, and must be repeatable all the same.
        with SeededGlobals(spec.asked.seed) as random:
            policy = opened.build(env, policy_options(spec))
            # A policy imports torch when it is built.
            random.take_torch()
            with EvaluationFolder.open(
                path, config, resume=spec.resume, overwrite=spec.overwrite
            ) as folder:
                here = _RolloutHere(spec, env, policy, folder, sinks)
                return _conclude(here, folder, alone)
    finally:
        close_policy(policy)
        env.close()


class _RolloutHere:
    """The missing episodes of an evaluation, in this process."""

    def __init__(
        self,
        spec: EvalSpec,
        env: RolloutEnv,
        policy: Policy,
        folder: EvaluationFolder,
        sinks: Sequence[Sink],
    ) -> None:
        self._spec = spec
        self._env = env
        self._policy = policy
        self._folder = folder
        self._films = film_sink(spec, folder.path)
        # StoreSink comes last: an episode with a record is complete in all other sinks, too.
        self._sinks = [self._films, *sinks, StoreSink(folder)]

    def run(self) -> None:
        """Roll them out."""
        missing = self._folder.missing(self._spec.episodes)
        seed = self._spec.asked.seed
        rollout(self._env, self._policy, missing, seed, self._sinks)

    @property
    def film_problem(self) -> str | None:
        """Why films are missing, or None."""
        return self._films.problem

    @property
    def requests(self) -> dict[str, Any]:
        """See `requests_of`."""
        return requests_of(self._policy)


def _conclude(
    rolling: _RolloutHere | SpreadRollout,
    folder: EvaluationFolder,
    alone: AloneRates | None,
) -> Run:
    """Roll out, and write summary and report.

    Raises:
        EvaluationInterrupted: Ctrl-C was pressed.
    """
    started = time.perf_counter()
    earlier = folder.earlier_seconds()
    interrupted = False
    try:
        rolling.run()
    # The finished episodes get their report before the interrupt goes on.
    except KeyboardInterrupt:
        interrupted = True
    seconds = earlier + time.perf_counter() - started
    run = finish(folder, seconds, rolling.film_problem, alone, rolling.requests)
    if interrupted:
        raise EvaluationInterrupted(run)
    return run


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
    # Options that have a key of their own would stand in the file twice.
    further = {name: value for name, value in options.items() if name not in apart}
    if further:
        chosen["env"] = plain(further)
    if asked.spawns:
        from mjhab.episodes.spawn_sets import SpawnSet

        # The content and hash of the set determine the episodes, not its path.
        chosen["spawns"] = SpawnSet.read(Path(asked.spawns)).describe()
    return {**chosen, "mjhab": __version__, "mujoco": version("mujoco")}


def default_out(spec: EvalSpec, policy: str) -> Path:
    """Default run folder; ``policy`` is the policy's name."""
    asked = spec.asked
    driven = "drive" if asked.navigate == "drive" and not asked.subtask else None
    words = (asked.task, asked.subtask, asked.target, driven, policy, f"seed{asked.seed}")
    return Path("runs") / "_".join(
        # Names of policies and targets have slashes and colons.
        re.sub(r"[^\w.-]+", "-", word)
        for word in words
        if word
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
        # The walls of a pack change what is possible, so that every summary tells them.
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


def _anything_left(path: Path, spec: EvalSpec) -> bool:
    if not spec.resume:
        return True
    done = {record.index for record in read_records(path)}
    return any(index not in done for index in range(spec.episodes))
