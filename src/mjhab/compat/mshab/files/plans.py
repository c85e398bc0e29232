"""Task plans of MS-HAB and their files, JSON or YAML: ``task_plans/<task>/<subtask>/<split>/<target>.json``."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from mjhab.compat.mshab.files.subtasks import SUBTASK_CLASSES, MsHabSubtask
from mjhab.core.errors import (
    about,
    fault,
    missing_field,
    unknown_name,
    wrong_type,
    wrong_value,
)
from mjhab.core.files.cache import write_text
from mjhab.core.files.reading import parse_json, read_bytes
from mjhab.core.typed.options import read_record
from mjhab.data.imports.ms_hab_layout import dataset_name
from mjhab.tasks.household.registry import TASKS

SPLITS = ("train", "val", "test")
MAX_PLANS_MB = 1024
"""Largest file of plans that is read [MB]; the published ones of 100,000 plans take about 70."""
_GIVEN_BY_FILE = ("uid", "composite_subtask_uids")


@dataclass
class MsHabTaskPlan:
    """The subtasks of one episode in order.

    ``build_config_name``: file name of the home's scene, ``v3_sc3_staging_00.scene_instance.json``.
    ``init_config_name``: path of the episode below the folder of rearrangement data, ``val/set_table/episode_0.json``.
    """

    root: ClassVar[Path | None] = None
    """Of one plan: the folder of rearrangement data from which it was read. Not a field: scripts write the fields."""

    subtasks: list[MsHabSubtask]
    build_config_name: str | None = None
    init_config_name: str | None = None


@dataclass
class PlanData:
    """The plans of a file, and the data set they are of: ``ReplicaCADSetTableVal``."""

    dataset: str
    plans: list[MsHabTaskPlan]


def plan_data_from_file(config_path: Any = None) -> PlanData:
    """Read a file of plans, ``.json``, ``.yml`` or ``.yaml``.

    Raises:
        UsageError: there is no such file, it is none of plans, or a plan lacks a field or has one of another type;
            the message names file and field.
    """
    if not isinstance(config_path, str | os.PathLike):
        raise wrong_type("a file of task plans", config_path, "its path")
    path = Path(config_path)
    body = _parsed(path)
    if not isinstance(body, Mapping):
        raise wrong_type(
            "a file of task plans", body, "an object with dataset and plans", where=path
        )
    for name in ("dataset", "plans"):
        if name not in body:
            raise missing_field(name, path, "This is no file of task plans.")
    if not isinstance(body["plans"], list):
        raise wrong_type("plans", body["plans"], "a list", where=path)
    with about(path):
        plans = [_plan(row, f"plans[{i}]") for i, row in enumerate(body["plans"])]
    root = root_above(path, "task_plans")
    for plan in plans:
        vars(plan)["root"] = root
    return PlanData(dataset=str(body["dataset"]), plans=plans)


def write_plan_data(path: Path, data: PlanData) -> None:
    """Write plans as JSON, atomically; inverse of `plan_data_from_file`."""
    text = json.dumps(dataclasses.asdict(data))
    write_text(path, text)


def task_of_dataset(name: str) -> tuple[str, str]:
    """Task and split of a data set; the name of its scene builder's class stands for it, too.

    Raises:
        UsageError: the name is not `dataset_name` of a task and split; the message lists those.
    """
    known = {
        dataset_name(task, split): (task, split) for task in TASKS for split in SPLITS
    }
    plain = str(name).removesuffix("SceneBuilder")
    if plain not in known:
        raise unknown_name("data set of task plans", name, known)
    return known[plain]


def root_above(path: Path, folder: str) -> Path | None:
    """The folder in which ``folder`` is that holds a file; None if no folder above the file has that name."""
    for parent in path.absolute().parents:
        if parent.name == folder:
            return parent.parent
    return None


def _parsed(path: Path) -> Any:
    raw = read_bytes(path, MAX_PLANS_MB)
    if path.suffix == ".json":
        with about(path):
            return parse_json(raw)
    if path.suffix not in (".yml", ".yaml"):
        raise wrong_value(
            "a file of task plans", str(path), "a file .json, .yml or .yaml"
        )
    try:
        import yaml
    except ImportError as error:
        raise fault(
            path, "plans in YAML need `pip install pyyaml`; JSON needs nothing."
        ) from error
    try:
        # Other loaders make whatever Python object a file names.
        return yaml.safe_load(raw)
    # PyYAML reads nested lists by recursion, which a file of brackets exhausts.
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        text = " ".join(str(error).split())
        raise fault(path, f"not valid YAML ({text}).") from error


def _plan(row: Any, where: str) -> MsHabTaskPlan:
    if not isinstance(row, Mapping):
        raise wrong_type(where, row, "an object")
    for name in ("subtasks", "build_config_name", "init_config_name"):
        if name not in row:
            raise missing_field(name, where)
    names = [
        read_record(str | None, row[name], f"{where}.{name}")
        for name in ("build_config_name", "init_config_name")
    ]
    if not isinstance(row["subtasks"], list) or not row["subtasks"]:
        raise wrong_value(f"{where}.subtasks", row["subtasks"], "a list of one or more")
    return MsHabTaskPlan(
        [
            _subtask(each, f"{where}.subtasks[{k}]")
            for k, each in enumerate(row["subtasks"])
        ],
        *names,
    )


def _subtask(row: Any, where: str) -> MsHabSubtask:
    if not isinstance(row, Mapping):
        raise wrong_type(where, row, "an object")
    kind = row.get("type")
    if kind not in SUBTASK_CLASSES:
        raise unknown_name(f"{where}.type", kind, SUBTASK_CLASSES)
    made = SUBTASK_CLASSES[kind]
    taken = {f.name for f in dataclasses.fields(made) if f.init}
    # What else a file holds is told to nobody in the original, too.
    found = read_record(made, {n: v for n, v in row.items() if n in taken}, where)
    for name in _GIVEN_BY_FILE:
        if row.get(name) is not None:
            hint = str if name == "uid" else list[str]
            setattr(found, name, read_record(hint, row[name], f"{where}.{name}"))
    return found
