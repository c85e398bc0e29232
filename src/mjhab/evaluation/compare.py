"""Runs beside each other: evaluations paired by episode, or training runs in one chart.

`compare` is `mjhab.compare`, and what ``mjhab compare`` does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError, fault, shown
from mjhab.core.files.cache import write_text
from mjhab.core.files.reading import read_json_object
from mjhab.core.files.run_folder import CONFIG
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options
from mjhab.reports.compared.page import (
    ComparedRun,
    Pair,
    differing,
    flat,
    pairs_of,
    render_comparison,
    render_trainings,
)
from mjhab.reports.compared.trainings import METRICS, read_metrics
from mjhab.reports.students import pack_name
from mjhab.rollout.records import EpisodeRecord
from mjhab.rollout.store import EPISODES_FILE, FILMS, read_records

OF_POLICY = frozenset(
    {
        "base",
        "camera_size",
        "cameras",
        "control_mode",
        "frame_stack",
        "obs_keys",
        "obs_mode",
        "reward_formula",
        "reward_mode",
        "reward_normaliser",
        "reward_scales",
        "stationary",
    }
)
"""Options of environments that say what a policy sees, moves and is told, and nothing of what is judged."""
FREE = OF_POLICY | {
    "alone",
    "episodes",
    "films",
    "instruction",
    "mjhab",
    "mujoco",
    "perturb",
    "policy",
    "style",
    "threads",
    "worlds",
}
"""Options that runs in one comparison may have of their own, besides those that begin with "policy_"."""
VERSIONS = ("mjhab", "mujoco")
TRAINING_SCENE = ("task", "subtask", "target", "assets", "profile", "robot")
"""Options of the scene of a training whose evaluations can stand in one chart."""


@dataclass(frozen=True)
class CompareSpec:
    """Compare runs: which one does more of the same episodes, and how sure that is.

    Two policies: `mjhab compare runs/mine runs/expert --out mine_or_expert.html`

    Evaluations (`mjhab eval`) are paired by seed and index, each with the first one: the difference in success with its
    paired interval and McNemar's p, the episodes that one alone does, the labels that change, films side by side. Runs
    with other rules, homes or episodes are refused. Training runs (`mjhab train`) come into one chart.

    Raises:
        UsageError: fewer than two runs, a folder without a run, or runs that cannot be compared.
    """

    runs: Annotated[
        tuple[Path, ...], Flag(metavar="FOLDER ...", positional=True), Bound(empty=False)
    ]
    """Folders of the runs, the one to compare with first."""
    out: Annotated[Path, Flag(metavar="FILE.html"), Output(".html")] = Path(
        "runs/compared.html"
    )
    """The self-contained page to write; an earlier one is replaced."""

    def __post_init__(self) -> None:
        take_options(self)
        if len(self.runs) < 2:
            raise UsageError(
                f"a comparison needs at least two runs, got {len(self.runs)}: mjhab compare RUN_A RUN_B."
            )


@dataclass(frozen=True)
class Comparison:
    """What `compare` found.

    Attributes:
        runs: the evaluations, in the order in which they were given; empty for training runs.
        pairs: each run after the first one, paired with the first.
        trainings: for training runs, success once of the last evaluation by name; None without any.
        report: path of the page.
        cautions: what limits the comparison, in sentences.
    """

    runs: tuple[ComparedRun, ...]
    pairs: tuple[Pair, ...]
    trainings: Mapping[str, float | None]
    report: Path
    cautions: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """All of it as plain data, but for the records."""
        told = {"report": str(self.report), "cautions": list(self.cautions)}
        if self.trainings:
            return {"trainings": dict(self.trainings), **told}
        runs = [
            {
                "name": run.name,
                "episodes": len(run.records),
                "success_once": run.success_once,
                "low": run.bounds[0],
                "high": run.bounds[1],
            }
            for run in self.runs
        ]
        pairs = [{"a": p.a, "b": p.b, **p.found.as_json()} for p in self.pairs]
        return {"runs": runs, "pairs": pairs, **told}


def compare(*runs: str | Path, out: str | Path = "runs/compared.html") -> Comparison:
    """Compare runs and write a page about it, as ``mjhab compare`` does.

    >>> import mjhab
    >>> asked = {"subtask": "close", "episodes": 2, "horizon": 5, "films": 0}
    >>> a = mjhab.evaluate("zero", **asked, out="runs/a").path
    >>> b = mjhab.evaluate("random", **asked, out="runs/b").path
    >>> mjhab.compare(a, b, out="runs/a_b.html").pairs[0].found.episodes
    2

    Args:
        *runs: folders of two or more runs, the one to compare with first.
        out: the page.

    Raises:
        UsageError: see `CompareSpec`.
    """
    return run_comparison(CompareSpec(tuple(map(Path, runs)), Path(out)))


def run_comparison(spec: CompareSpec) -> Comparison:
    """`compare`, for a specification."""
    kinds = [_kind_of(folder) for folder in spec.runs]
    if len(set(kinds)) > 1:
        told = ", ".join(f"{p} ({k})" for p, k in zip(spec.runs, kinds, strict=True))
        raise UsageError(f"evaluations and training runs cannot be compared: {told}.")
    names = names_of(spec.runs)
    return (_trainings if kinds[0] == METRICS else _evaluations)(spec, names)


def _kind_of(folder: Path) -> str:
    """The file that tells what kind of run a folder holds."""
    for name in (EPISODES_FILE, METRICS):
        if (folder / name).is_file():
            return name
    raise UsageError(
        f"{folder} holds no run: it has neither {EPISODES_FILE} of `mjhab eval` nor {METRICS} of `mjhab train`.",
        option="runs",
        given=str(folder),
    )


def names_of(folders: Sequence[Path]) -> list[str]:
    """What runs are called: the last parts of their paths, as many as tell them apart.

    Raises:
        UsageError: a folder is named twice.
    """
    parts = [folder.resolve().parts for folder in folders]
    if len(set(parts)) < len(parts):
        raise UsageError(
            f"a run is named twice: {', '.join(map(str, folders))}.", option="runs"
        )
    for count in range(1, max(map(len, parts)) + 1):
        # Resolved paths: "." and "runs/a/" have no last part of their own.
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    raise AssertionError("different paths have different parts")


def _evaluations(spec: CompareSpec, names: Sequence[str]) -> Comparison:
    runs = tuple(
        _read(folder, name) for folder, name in zip(spec.runs, names, strict=True)
    )
    for run in runs[1:]:
        _check_rules(runs[0], run)
        _check_episodes(runs[0], run)
    pairs = tuple(pairs_of(runs))
    cautions = tuple(_cautions(runs, pairs))
    write_text(spec.out, render_comparison(runs, pairs, cautions))
    return Comparison(runs, pairs, {}, spec.out, cautions)


def _read(folder: Path, name: str) -> ComparedRun:
    records = read_records(folder)
    if not records:
        raise fault(folder, "has no finished episode yet.")
    films = {
        record.index: folder / FILMS / f"episode_{record.index:05d}.mp4"
        for record in records
    }
    filmed = {index: film for index, film in films.items() if film.is_file()}
    return ComparedRun(name, _options(folder), records, filmed)


def _options(folder: Path) -> dict[str, Any]:
    """The options of a run, one by one; a pack by its name and stage, wherever it lies."""
    config = read_json_object(folder / CONFIG)
    env = config.pop("env", None)
    if isinstance(env, Mapping):
        config |= env
    if config.get("assets"):
        # Two machines may keep the same pack in different folders.
        config["assets"] = pack_name(config["assets"])
    return flat(config)


def rules_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """The options that two runs must share: rules, homes, stage, profile, episodes; defaults left out."""
    # An option that one run tells with its default and the other not at all is the same.
    usual = {option.name: option.default for option in dataclasses.fields(EnvConfig)}
    return {
        name: value
        for name, value in config.items()
        if value not in (None, usual.get(name))
        and not name.startswith("policy_")
        and name not in FREE
    }


def _check_rules(first: ComparedRun, other: ComparedRun) -> None:
    rules = [rules_of(run.config) for run in (first, other)]
    found = differing(rules)
    if found:
        said = "; ".join(f"{name}: {shown(a)} and {shown(b)}" for name, (a, b) in found)
        raise UsageError(
            f"{first.name} and {other.name} have other rules, homes or episodes, so their rates say nothing about each "
            f"other: {said}. Evaluate both with the same options.",
            option="runs",
            given=[name for name, _ in found],
        )


def _check_episodes(first: ComparedRun, other: ComparedRun) -> None:
    # Runs of different lengths are compared in what they share; the caution says so.
    shared = sorted(set(first.by_index) & set(other.by_index))
    if not shared:
        raise UsageError(
            f"{first.name} and {other.name} have no episode in common.", option="runs"
        )
    for index in shared:
        # Equal indices are equal episodes within one version only.
        a, b = first.by_index[index], other.by_index[index]
        if _identity(a) != _identity(b):
            raise UsageError(
                f"episode {index} is another one in {other.name} than in {first.name} (home {a.home} and {b.home}): an "
                "older version drew them. Evaluate both with one version.",
                option="runs",
            )


def _identity(record: EpisodeRecord) -> tuple[object, ...]:
    """What makes a record one of a certain episode, whatever was done in it."""
    plan = tuple((entry.kind, entry.target) for entry in record.plan)
    return record.seed, record.home, record.task, record.split, plan


def _cautions(runs: Sequence[ComparedRun], pairs: Sequence[Pair]) -> list[str]:
    found = []
    for name in VERSIONS:
        versions = {str(run.config.get(name)) for run in runs}
        if len(versions) > 1:
            found.append(
                f"The runs are of different versions of {name}: {', '.join(sorted(versions))}."
            )
    perturbed = {str(run.config.get("perturb") or "nothing") for run in runs}
    if len(perturbed) > 1:
        found.append(f"Perturbed are: {', '.join(sorted(perturbed))}.")
    by_name = {run.name: run for run in runs}
    for pair in pairs:
        counts = [len(by_name[name].records) for name in (pair.a, pair.b)]
        if max(counts) > pair.found.episodes:
            found.append(
                f"{pair.b} and {pair.a} share {pair.found.episodes} episodes of {counts[1]} and {counts[0]}."
            )
    for run in runs:
        tainted = sum(bool(record.taint or record.error) for record in run.records)
        if tainted:
            found.append(
                f"{tainted} episodes of {run.name} have a flag of the simulation or an error of the policy; they count."
            )
    return found


def _trainings(spec: CompareSpec, names: Sequence[str]) -> Comparison:
    rows = dict(zip(names, map(read_metrics, spec.runs), strict=True))
    configs = [_training_options(folder) for folder in spec.runs]
    scenes = [
        {key: config.get(f"scene.{key}") or "" for key in TRAINING_SCENE}
        for config in configs
    ]
    for name, scene in zip(names[1:], scenes[1:], strict=True):
        if found := differing([scenes[0], scene]):
            said = "; ".join(f"{key}: {shown(a)} and {shown(b)}" for key, (a, b) in found)
            raise UsageError(
                f"{names[0]} and {name} were trained for something else: {said}.",
                option="runs",
                given=[key for key, _ in found],
            )
    last = {
        name: next(
            # The last evaluation is the one that the run reports.
            (row["success_once"] for row in reversed(of_run) if "success_once" in row),
            None,
        )
        for name, of_run in rows.items()
    }
    write_text(spec.out, render_trainings(rows, configs))
    return Comparison((), (), last, spec.out)


def _training_options(folder: Path) -> dict[str, Any]:
    config = read_json_object(folder / CONFIG)
    scene = config.get("scene")
    if isinstance(scene, Mapping) and scene.get("assets"):
        config["scene"] = {**scene, "assets": pack_name(scene["assets"])}
    return flat(config)
