"""The request for a reproduction, and its validation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjhab.config.env import SPLITS
from mjhab.config.profile_choice import ProfileChoice, profile_options
from mjhab.config.profiles import profile_named
from mjhab.core.errors import UsageError, unknown_name
from mjhab.learning.configs import BC, preset_of
from mjhab.paper.reproduce.rows import (
    COLUMNS,
    STUDENTS,
    TableRow,
    algorithm_of,
    place_rows,
    rows_of_task,
    table_rows,
    task_rows,
)
from mjhab.paper.reproduce.variants import (
    CHOICES,
    DEMO_COUNT,
    FILTERS,
    GOAL_ZONES,
    LONG_HORIZON,
    STUDIES,
    VARIANTS,
    Variant,
)
from mjhab.robots.registry import robot_named

DEFAULT_PRESETS = {STUDENTS: "small"}
REINFORCEMENT_PRESET = "fast"
DEFAULT_ROWS = {
    DEMO_COUNT: ("tidy_house/pick",),
    FILTERS: ("prepare_groceries/place",),
    CHOICES: ("set_table/open/drawer", "tidy_house/place"),
}
"""Rows of a study if none are named."""

TRAINED_IN = "train"
"""Split of the homes of training, which the record of a run also names for its final evaluation, of no episodes."""


@dataclass(frozen=True, kw_only=True)
class TableSpec(ProfileChoice):
    """Which policies to train and evaluate, and with which resources.

    what: one of VARIANTS. out: folder of the runs. rows: names of rows, () for all rows of the result.
    preset: of `mjhab train`; "" selects "small" for students and "fast" for reinforcement learning.
    budget_minutes: time limit for training each policy, 0 for no limit.
    split, episodes, films: of the evaluation; the policies of a row share its episodes.
    worlds: parallel worlds of evaluation and of collection. worlds, threads: change the speed, not the results.
    resume: complete the runs that ``out`` already holds. column: one of COLUMNS.
    policies: folder of an earlier reproduction whose policies are evaluated; None trains new ones.
    backend, device: of the environments of reinforcement learning, see `EnvConfig`; for students device is that of the
    network, see `training_device`. demos: number of episodes that the expert tries for each data set of a study, 0 for
    that of the preset. updates: of each network of a study, 0 for those of the preset. workers: processes of
    the expert in a study; they change the speed, not the results. variants: names of variants of the result, () for
    all; those of an earlier start of the same folder stay.
    """

    what: str
    out: Path
    rows: tuple[str, ...]
    preset: str
    budget_minutes: float
    split: str
    episodes: int
    films: int
    seed: int
    assets: str
    worlds: int
    threads: int
    resume: bool
    column: str = STUDENTS
    policies: Path | None = None
    backend: str = "cpu"
    device: str = ""
    demos: int = 0
    updates: int = 0
    workers: int = 1
    variants: tuple[str, ...] = ()

    @property
    def preset_name(self) -> str:
        """Name of the preset, defaults resolved."""
        return self.preset or DEFAULT_PRESETS.get(self.column, REINFORCEMENT_PRESET)


def env_of(spec: TableSpec, row: TableRow, target: str) -> dict[str, Any]:
    """Options of the environment in which a policy of a row is trained."""
    return {
        "task": row.task,
        "subtask": row.subtask,
        "target": target,
        "assets": spec.assets,
        "seed": spec.seed,
        "threads": spec.threads,
        **profile_options(spec),
    }


def known_rows(what: str) -> dict[str, TableRow]:
    """The rows of a result by name.

    Raises:
        UsageError: there is no such result.
    """
    if what not in VARIANTS:
        raise unknown_name("result of the paper", what, tuple(VARIANTS))
    if what == LONG_HORIZON:
        return task_rows()
    return place_rows() if what in (GOAL_ZONES, FILTERS) else table_rows()


def chosen_variants(spec: TableSpec) -> list[Variant]:
    """The requested variants of the result, in its order.

    Raises:
        UsageError: the result has no variant of that name.
    """
    known = {variant.name: variant for variant in VARIANTS[spec.what]}
    for name in spec.variants:
        if name not in known:
            raise unknown_name(f"variant of {spec.what}", name, known)
    wanted = spec.variants or tuple(known)
    return [variant for name, variant in known.items() if name in wanted]


def policy_rows(row: TableRow) -> list[TableRow]:
    """The rows of Table 1 whose policies a row evaluates: the row itself, or all rows of a whole task."""
    return [row] if row.subtask else rows_of_task(row.task)


def chosen_rows(spec: TableSpec) -> list[TableRow]:
    """The requested rows, each once.

    Raises:
        UsageError: a name is unknown, or ``policies`` is not the folder of a reproduction.
        MjhabError: the robot lacks its files.
    """
    known = known_rows(spec.what)
    chosen_variants(spec)
    for name in spec.rows:
        if name not in known:
            raise unknown_name("row", name, known)
    if spec.split not in SPLITS:
        raise unknown_name("split", spec.split, SPLITS)
    if spec.column not in COLUMNS:
        raise unknown_name("column", spec.column, COLUMNS)
    profile_named(spec.profile)
    if spec.what in STUDIES and spec.column != STUDENTS:
        raise UsageError(
            f"{spec.what} is about imitation: leave out --column {spec.column}."
        )
    if spec.what in STUDIES and spec.policies is not None:
        raise UsageError(f"{spec.what} compares ways of training: leave out --policies.")
    for name in ("demos", "updates"):
        if getattr(spec, name) and spec.what not in STUDIES:
            raise UsageError(
                f"--{name} is for {', '.join(STUDIES)}, not for {spec.what}."
            )
    if spec.robot:
        # The files of a robot may not be installed.
        _ = robot_named(spec.robot).body
    names = spec.rows or DEFAULT_ROWS.get(spec.what, known)
    rows = [known[name] for name in dict.fromkeys(names)]
    for row in rows:
        for part in policy_rows(row):
            _check_preset(spec, part)
    if spec.policies is not None and not (spec.policies / "config.json").is_file():
        raise UsageError(
            f"{spec.policies} is not a folder of `mjhab reproduce`: it has no config.json."
        )
    return rows


def _check_preset(spec: TableSpec, row: TableRow) -> None:
    """Refuse a preset that the algorithm of a row does not have."""
    algorithm = BC if spec.what in STUDIES else algorithm_of(row, spec.column)
    if spec.column == STUDENTS:
        preset_of(algorithm, spec.preset_name)
        return
    from mjhab.learning.reinforcement.configs import reinforcement_preset

    reinforcement_preset(algorithm, spec.preset_name)


def table_config(spec: TableSpec) -> dict[str, Any]:
    """The part of the config that all rows of a folder share, as JSON data."""
    names = (
        "what",
        "column",
        "budget_minutes",
        "split",
        "episodes",
        "seed",
        "assets",
        "backend",
    )
    shown = {name: getattr(spec, name) for name in names}
    policies = {} if spec.policies is None else {"policies": str(spec.policies)}
    given = {
        name: getattr(spec, name) for name in ("demos", "updates") if getattr(spec, name)
    }
    return {
        **shown,
        **given,
        "preset": spec.preset_name,
        **policies,
        **profile_options(spec),
    }
