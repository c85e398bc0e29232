"""Scores under perturbations: the same episodes once more for every axis, paired with those of the score."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mjhab.config.env import EnvConfig
from mjhab.config.perturbing import PERTURBATIONS, axes_text
from mjhab.core.conventions.images import RGB, TARGET_RGB
from mjhab.core.files.cache import write_json, write_text
from mjhab.envs.observations.modes import DRAWN_OUTPUTS, POINTCLOUD, mode_outputs
from mjhab.evaluation.evaluate import EvalSpec, run_evaluation
from mjhab.evaluation.parts import describe_policy
from mjhab.evaluation.resolve import full_spec
from mjhab.evaluation.score.manifest import ScoreRow
from mjhab.evaluation.score.result import (
    RESULT_FILE,
    ScoreResult,
    write_result,
    write_summary,
)
from mjhab.evaluation.score.run import SUMMARY_FILE, evaluation_of, folder_name
from mjhab.evaluation.score.spec import ScoreSpec
from mjhab.reports.compared.page import bars, points
from mjhab.reports.compared.paired import Paired, paired, together
from mjhab.reports.metrics import mean, wilson
from mjhab.reports.pages import Section, render_sections
from mjhab.reports.words import percent
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.sinks import Sink

FOLDER = "perturbed"
ROBUSTNESS_FILE = "robustness.json"
ROBUSTNESS_PAGE = "robustness.html"
CLEAN = "clean"


@dataclass(frozen=True)
class PerturbedArm:
    """The episodes of a score under one axis.

    Attributes:
        axis: name of the axis. level: 1 to 5.
        rows: by row, what `paired` says of the score (A) and of this arm (B).
        won: by row, number of episodes that this arm does.
        unreached: rows whose policy the axis does not reach, see `Perturbation.reaches`: their episodes are those of
            the score and are not run again.
        redrawn: changes of starts that were impossible and drawn again.
        kept: episodes in which no change of the start was possible.
    """

    axis: str
    level: int
    rows: Mapping[str, Paired]
    won: Mapping[str, int]
    unreached: tuple[str, ...] = ()
    redrawn: int = 0
    kept: int = 0

    @property
    def found(self) -> Paired:
        """Episodes of all rows together."""
        return together(list(self.rows.values()))

    @property
    def success_once(self) -> float:
        """Share of the episodes of all rows."""
        count = self.found.episodes
        return round(sum(self.won.values()) / count, 4) if count else 0.0

    @property
    def bounds(self) -> tuple[float, float]:
        """Wilson 95 % interval of ``success_once``."""
        return wilson(sum(self.won.values()), self.found.episodes)

    def as_json(self) -> dict[str, Any]:
        """Its numbers, as `mjhab score --perturb --json` prints them."""
        found = self.found
        low, high = found.interval
        return {
            "axis": self.axis,
            "level": self.level,
            "success_once": self.success_once,
            "difference": found.difference,
            "low": low,
            "high": high,
            "episodes": found.episodes,
        }

    def details(self) -> dict[str, Any]:
        """`as_json`, with McNemar's p, the labels that change, and the same of every row."""
        labels = self.found.as_json()["labels"]
        rows = {name: pair.as_json() for name, pair in self.rows.items()}
        told = {"p": self.found.p, "labels": labels, "rows": rows}
        told |= {"redrawn": self.redrawn, "kept": self.kept}
        return {**self.as_json(), **told, "unreached": list(self.unreached)}


@dataclass(frozen=True)
class Robustness:
    """A score and its arms. result: the score, whose facts tell the numbers of the arms. success_once: without
    perturbations."""

    result: ScoreResult
    success_once: float
    arms: tuple[PerturbedArm, ...]


def score_perturbed(
    spec: ScoreSpec,
    result: ScoreResult,
    sinks: Callable[[EvalSpec], Sequence[Sink]] = lambda _: (),
) -> Robustness:
    """Run the missing episodes of every axis of ``spec.perturb``; write robustness.json and robustness.html.

    The numbers of the arms are also put into ``facts["perturbed"]`` of the result file and its summary.

    Args:
        spec: the score.
        result: of the same ``spec``, see `run.score`.
        sinks: makes further listeners for an evaluation.

    Raises:
        UsageError: a folder holds another run.
    """
    asked = result.manifest
    clean: dict[str, list[EpisodeRecord]] = {row.name: [] for row in asked.rows}
    for episode in result.episodes:
        # Both sides of a pair are judged by the same rule.
        clean[episode.row].append(judged(episode.record))
    policies = result.facts["policies"]
    rows = [row for row in asked.rows if row.name in policies]
    arms = []
    for axis, level in spec.axes.items():
        found = {}
        won = {}
        unreached = []
        drawn: list[Mapping[str, Any]] = []
        for row in rows:
            if _reached(spec, row, axis, policies[row.name]["env_options"]):
                records = _records(spec, result, row, axes_text({axis: level}), sinks)
            else:
                # The policy could not notice the axis: running it again would give the same episodes.
                records = clean[row.name]
                unreached.append(row.name)
            found[row.name] = paired(clean[row.name], records)
            won[row.name] = sum(record.success_once is True for record in records)
            drawn += [record.perturbation.get(axis, {}) for record in records]
        again = ("redrawn", "refused")
        redrawn = sum(int(told.get(name, 0)) for told in drawn for name in again)
        kept = sum(bool(told.get("kept")) for told in drawn)
        arm = PerturbedArm(axis, level, found, won, tuple(unreached), redrawn, kept)
        arms.append(arm)
    numbers = [arm.as_json() for arm in arms]
    facts = {**result.facts, "perturbed": numbers}
    result = write_result(spec.folder / RESULT_FILE, facts, result.episodes)
    write_summary(spec.folder / SUMMARY_FILE, result)
    every = [record for records in clean.values() for record in records]
    robustness = Robustness(
        result, mean(record.success_once for record in every), tuple(arms)
    )
    _write(spec, robustness, every)
    return robustness


def judged(record: EpisodeRecord) -> EpisodeRecord:
    """A record as a score counts it: tainted episodes, and those that the policy could not finish, are no success."""
    valid = not (record.taint or record.error)
    return dataclasses.replace(record, success_once=record.success_once and valid)


def _reached(
    spec: ScoreSpec, row: ScoreRow, axis: str, options: Mapping[str, Any]
) -> bool:
    """Whether an axis may change what the policy of a row does, which sees the images of ``options``."""
    facts = describe_policy(
        full_spec(spec.policy, row.task, row.subtask or None, row.target or None)
    )
    images = mode_outputs(options.get("obs_mode", EnvConfig().obs_mode))
    if POINTCLOUD in images:
        # Point clouds are made of colour and depth.
        images += DRAWN_OUTPUTS
    if TARGET_RGB in images:
        images += (RGB,)
    return PERTURBATIONS[axis].reaches(images, facts.reads_instruction)


def _records(
    spec: ScoreSpec,
    result: ScoreResult,
    row: ScoreRow,
    axes: str,
    sinks: Callable[[EvalSpec], Sequence[Sink]],
) -> list[EpisodeRecord]:
    """Episodes of a row of an arm; those that are there already are not run again."""
    asked = result.manifest
    options = {**result.facts["policies"][row.name]["env_options"], "perturb": axes}
    found: list[EpisodeRecord] = []
    for seed in asked.seeds:
        plain = evaluation_of(spec, asked, row, seed, options)
        out = (
            spec.folder / FOLDER / axes.replace(":", "_") / folder_name(asked, row, seed)
        )
        evaluation = dataclasses.replace(plain, out=out, resume=out.exists(), films=0)
        run = run_evaluation(evaluation, sinks(evaluation))
        found += [judged(r) for r in run.records if r.index < evaluation.episodes]
    return found


def _write(
    spec: ScoreSpec, robustness: Robustness, clean: Sequence[EpisodeRecord]
) -> None:
    content = {
        "policy": robustness.result.facts["policy"],
        "track": robustness.result.facts["track"],
        CLEAN: {"success_once": robustness.success_once, "episodes": len(clean)},
        "axes": [arm.details() for arm in robustness.arms],
    }
    write_json(spec.folder / ROBUSTNESS_FILE, content)
    write_text(spec.folder / ROBUSTNESS_PAGE, robustness_page(robustness, clean))


_DIFFERENCES = (
    ("axis", ""),
    ("level", "n"),
    ("what it changes", "words"),
    ("success once", "n"),
    ("difference", "n"),
    ("95 % interval", "n"),
    ("p", "n"),
    ("lost", "n"),
    ("won", "n"),
    ("episodes", "n"),
    ("redrawn", "n"),
    ("kept", "n"),
)
_CHANGES = (
    ("arm", ""),
    ("label in clean", ""),
    ("label in the arm", ""),
    ("subtasks", "n"),
)
"""Columns of the tables of differences and of changed labels, with their styles."""


def robustness_page(robustness: Robustness, clean: Sequence[EpisodeRecord]) -> str:
    """The page of a score under perturbations: bars of all arms, differences, labels that change."""
    arms = robustness.arms
    won = sum(record.success_once is True for record in clean)
    facts = robustness.result.facts
    names = [CLEAN, *(f"{arm.axis} {arm.level}" for arm in arms)]
    rates = [robustness.success_once, *(arm.success_once for arm in arms)]
    bounds = [wilson(won, len(clean)), *(arm.bounds for arm in arms)]
    changes = [
        (f"{arm.axis} {arm.level}", before, after, count)
        for arm in arms
        for before, after, count in arm.found.labels
    ]
    return render_sections(
        f"{facts['policy']}, {facts['track']}, under perturbations",
        [
            Section(
                "Success once",
                "The same episodes without and with each axis; whiskers are Wilson 95 % intervals.",
                chart="arms-plot",
            ),
            Section(
                "Differences",
                "Perturbed minus clean, paired by row, seed and index: intervals by Newcombe, p by McNemar, exact. "
                "Redrawn: changes of starts that were impossible; kept: episodes in which none was possible."
                + _unreached(arms),
                columns=_DIFFERENCES,
                rows=[_cells(arm) for arm in arms],
            ),
            Section(
                "Labels that change",
                "Subtasks of the same episodes that ended with another label.",
                columns=_CHANGES,
                rows=changes,
            ),
        ],
        {"arms-plot": bars(names, rates, bounds)},
    )


def _unreached(arms: Sequence[PerturbedArm]) -> str:
    """A sentence on the axes whose episodes are those of the score."""
    names = [arm.axis for arm in arms if len(arm.unreached) == len(arm.rows)]
    if not names:
        return ""
    return f" Nothing of {', '.join(names)} reaches the policy: these episodes are the clean ones."


def _cells(arm: PerturbedArm) -> tuple[object, ...]:
    found = arm.found
    return (
        arm.axis,
        arm.level,
        PERTURBATIONS[arm.axis].about,
        percent(arm.success_once),
        points(found.difference),
        points(*found.interval),
        f"{found.p:.3g}",
        len(found.only_a),
        len(found.only_b),
        found.episodes,
        arm.redrawn,
        arm.kept,
    )
