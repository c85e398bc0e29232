"""The request for a reproduction, and its validation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from mjhab.config.env import EnvConfig
from mjhab.config.env_spec import PROFILE, EnvSpec, env_options
from mjhab.config.profiles import MS_HAB
from mjhab.core.errors import fault, unknown_name, wrong_value
from mjhab.core.typed.bounds import Bound, Output, Positive
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import taken
from mjhab.learning.changes import with_changes
from mjhab.learning.configs import BC, preset_of
from mjhab.paper.reproduce.rows import (
    POLICY_COLUMNS,
    RL_ALL,
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
    PER_ALL,
    REWARDED,
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
    PER_ALL: tuple(row.name for row in table_rows().values() if not row.target),
}
"""Rows of a study if none are named."""

TRAINED_IN = "train"
"""Split of the homes of training, which the record of a run also names for its final evaluation, of no episodes."""


@dataclass(frozen=True, kw_only=True)
class TableSpec(EnvSpec):
    """Train policies for results of the MS-HAB paper, evaluate them, and compare them with the paper's policies.

    `mjhab reproduce table1 --rows set_table/close/drawer --preset quick --budget-minutes 20 --out runs/table1`

    `mjhab reproduce force_limits --policies runs/table1 --out runs/force_limits`

    Every policy is trained in the homes of split train and has its own folder in --out. Ctrl-C keeps finished parts;
    the same command with `--resume` continues.
    """

    what: Annotated[
        str,
        Flag(
            metavar="table1|table5|demo_count|filters|choices|force_limits|goal_zones|long_horizon|sac_ppo|per_all|curves",
            positional=True,
        ),
    ]
    """table1: success in single subtasks, ten rows. force_limits: the same policies without force limits, and with a
    limit of 1,400 N x steps. goal_zones: Place with goals of other shapes. long_horizon: whole tasks, with one policy
    per subtask, unchanged and simplified. table5: behaviour cloning and the diffusion policy. demo_count: 1 to 1,000
    demonstrations per object (of --rows, else tidy_house/pick). filters: Place from objects put down, dropped, or both
    (of --rows, else prepare_groceries/place). choices: a preset of `mjhab train bc` with one choice changed at a time:
    chunk, image size, noise of the expert, ... (of --rows, else set_table/open/drawer and tidy_house/place). sac_ppo:
    rows by SAC and by PPO. per_all: one policy per object and one for all, with the failures of each (of --rows, else
    Pick and Place). curves: success while policies learn, three seeds."""
    out: Annotated[Path, Flag(metavar="FOLDER"), Output()]
    """Folder of the runs, of results.json and of report.html."""
    rows: Annotated[
        tuple[str, ...], Flag(metavar="ROW ...", shown="default: all of them")
    ] = ()
    """Which rows: TASK/pick, TASK/place, set_table/open/drawer, set_table/close/fridge, ...; all ten if absent."""
    variants: Annotated[
        tuple[str, ...], Flag(metavar="NAME ...", shown="default: all of them")
    ] = ()
    """Make only these variants: of choices preset, chunk_1, px_64, ...; of demo_count demos_10, ...; of force_limits
    evaluation, no_force_limit, ...; all if absent. The same command with `--resume` and other names adds those."""
    column: Annotated[str, Flag(metavar="students|rl_per|rl_all")] = STUDENTS
    """students: imitation by take-over DAgger, one policy per row. rl_per: reinforcement learning, one policy per
    object. rl_all: reinforcement learning, one policy per row. PPO trains Open and Close, SAC the others, as in the
    paper."""
    preset: Annotated[str, Flag(shown="default: small, or fast")] = ""
    """Preset of `mjhab train dagger` (small if absent), or of ppo and sac (fast if absent)."""
    set: Annotated[
        tuple[str, ...], Flag(metavar="NAME=VALUE ...", shown="default: none")
    ] = ()
    """Change fields of the preset, as in `mjhab train`, e.g. inputs.target_in_hand=true. The studies of imitation have
    --variants for that."""
    policies: Annotated[Path | None, Flag(metavar="FOLDER", shown="default: none")] = None
    """Evaluate the policies of this earlier --out instead of training; it must have those of all requested rows."""
    budget_minutes: Annotated[float, Flag(metavar="MINUTES")] = 0.0
    """Time limit for training each policy [min]; 0 for no limit."""
    demos: int = 0
    """In table5, demo_count, filters and choices: episodes that the expert tries per data set; those of the preset if
    absent."""
    updates: int = 0
    """In table5, demo_count, filters and choices: updates of each network; those of the preset if absent."""
    workers: Annotated[int, Bound(1, 256)] = 1
    """In table5, demo_count, filters and choices: processes of the expert. Changes the speed, never the results."""
    episodes: Positive = 500
    """Evaluation episodes per row; its policies share them."""
    films: Annotated[int, Bound(most=10_000)] = 0
    """Film the first N of them."""
    resume: bool = False
    """Continue in --out; finished rows are not run again."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            *PROFILE,
            "split",
            "seed",
            "assets",
            "num_envs",
            "threads",
            "backend",
            "device",
            docs={
                "profile": "Environment of training and evaluation; ms_hab is that of the paper.",
                "split": "Homes of the evaluation: train, val or test.",
                "seed": "Seed of everything.",
                "num_envs": "Episodes that run at the same time. Changes the speed, never the results.",
                "threads": "Threads of physics and network; 0 takes all cores. The last bits of the weights depend on "
                "it.",
                "backend": "Simulation backend of reinforcement learning: cpu, warp (on a GPU), or auto. Evaluation is "
                "on the CPU.",
                "device": "With backend warp: cuda:0, cuda:1, ...; the first one if absent. For students: where "
                "networks are trained, as in `mjhab train bc`.",
            },
            profile=MS_HAB.name,
            split="val",
            num_envs=16,
        ),
    ] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`."""

    @cached_property
    def asked(self) -> EnvConfig:
        """The environment as it was asked for; the device of students is that of their network."""
        options = self.env_options
        # The same word names where networks are trained, which a backend on the CPU would refuse.
        if options.get("backend", "cpu") == "cpu":
            taken(EnvConfig, "device", options.pop("device", ""))
        return EnvConfig(**options)

    @property
    def of_profile(self) -> dict[str, Any]:
        """The options about the profile and the robot."""
        return {
            name: value for name, value in self.env_options.items() if name in PROFILE
        }

    @property
    def device(self) -> str:
        """Device of networks or of the environments of reinforcement learning; "" if absent."""
        return self.env.get("device", "")

    @property
    def preset_name(self) -> str:
        """Name of the preset, defaults resolved."""
        column = RL_ALL if self.what in REWARDED else self.column
        return self.preset or DEFAULT_PRESETS.get(column, REINFORCEMENT_PRESET)


def env_of(spec: TableSpec, row: TableRow, target: str) -> dict[str, Any]:
    """Options of the environment in which a policy of a row is trained."""
    return {
        "task": row.task,
        "subtask": row.subtask,
        "target": target,
        "assets": spec.asked.assets,
        "seed": spec.asked.seed,
        "threads": spec.asked.threads,
        **spec.of_profile,
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
    if spec.column not in POLICY_COLUMNS:
        raise unknown_name("column", spec.column, POLICY_COLUMNS)
    # Made here, so that wrong options are told before hours of training.
    _ = spec.asked
    compares = spec.what in (*STUDIES, *REWARDED)
    if compares and spec.column != STUDENTS:
        raise wrong_value(
            "column",
            spec.column,
            f"left out with {spec.what}, whose variants say how policies are trained",
        )
    if compares and spec.policies is not None:
        raise fault(spec.what, "compares ways of training: leave out --policies.")
    for name in ("demos", "updates"):
        if getattr(spec, name) and spec.what not in STUDIES:
            raise wrong_value(
                name,
                getattr(spec, name),
                f"left out with {spec.what}; it is for {', '.join(STUDIES)}",
            )
    if spec.set and spec.what in STUDIES:
        raise wrong_value(
            "set",
            spec.set,
            f"left out with {spec.what}, whose variants say what of the preset is changed",
        )
    if "robot" in spec.env:
        # The files of a robot may not be installed.
        _ = robot_named(spec.asked.robot).body
    names = spec.rows or DEFAULT_ROWS.get(spec.what, known)
    rows = [known[name] for name in dict.fromkeys(names)]
    for row in rows:
        for part in policy_rows(row):
            # For every row in advance: the tenth would otherwise fail after nine trainings.
            _check_preset(spec, part)
    if spec.policies is not None and not (spec.policies / "config.json").is_file():
        raise fault(
            spec.policies, "not a folder of `mjhab reproduce`: it has no config.json."
        )
    return rows


def _check_preset(spec: TableSpec, row: TableRow) -> None:
    """Refuse a preset that the algorithm of a row does not have, and changes that it cannot have."""
    if spec.what in STUDIES:
        preset_of(BC, spec.preset_name)
        return
    algorithms = {algorithm_of(row, spec.column)}
    if spec.what in REWARDED:
        ways = [variant.reinforcement for variant in chosen_variants(spec)]
        algorithms = {
            way.algorithm or algorithm_of(row, way.column) for way in ways if way
        }
    elif spec.column == STUDENTS:
        chosen = preset_of(algorithm_of(row, spec.column), spec.preset_name)
        with_changes(chosen, spec.set)
        return
    from mjhab.learning.reinforcement.configs import reinforcement_preset

    for algorithm in algorithms:
        with_changes(reinforcement_preset(algorithm, spec.preset_name), spec.set)


def table_config(spec: TableSpec) -> dict[str, Any]:
    """The part of the config that all rows of a folder share, as JSON data."""
    shown = {
        "what": spec.what,
        "column": spec.column,
        "budget_minutes": spec.budget_minutes,
        "split": spec.asked.split,
        "episodes": spec.episodes,
        "seed": spec.asked.seed,
        "assets": spec.asked.assets,
        "backend": spec.asked.backend,
    }
    policies = {} if spec.policies is None else {"policies": str(spec.policies)}
    given: dict[str, Any] = {
        name: getattr(spec, name) for name in ("demos", "updates") if getattr(spec, name)
    }
    if spec.set:
        given["set"] = list(spec.set)
    return {
        **shown,
        **given,
        "preset": spec.preset_name,
        **policies,
        **spec.of_profile,
    }
