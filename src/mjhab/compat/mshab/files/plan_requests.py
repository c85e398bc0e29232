"""What starts of task plans are made of: plans and their files, checked against each other and against the homes."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjhab.compat.mshab.files.init_configs import read_init_config
from mjhab.compat.mshab.files.matching import home_of
from mjhab.compat.mshab.files.plans import MsHabTaskPlan, root_above
from mjhab.compat.mshab.files.spawn_data import Spawns, read_spawn_data
from mjhab.compat.mshab.paths import REARRANGE, REPLICA_CAD
from mjhab.core.errors import UsageError, fault, wrong_value
from mjhab.core.version import __version__
from mjhab.data.imports.ms_hab_layout import dataset_name
from mjhab.episodes.hab.format import HabEpisode
from mjhab.scenes.packs import open_pack

BUILTIN = "builtin"
# Part of the key of the cache: to be raised when the same files give other starts.
_VERSION = 1
_SHOWN = 5


@dataclass(frozen=True)
class PlanRequest:
    """What starts are made of.

    Attributes:
        plans: task plans, all of one kind of subtask, or whole tasks.
        dataset: data set of the plans, ``ReplicaCADSetTableVal``; "" for that of the folder of the first one's episode.
        subtask: kind of the plans' one subtask; "" for whole tasks.
        spawn_file: spawn data of the subtasks; None for whole tasks.
        root: folder of rearrangement data, below which are the episodes that plans name; None: that from which they
            were read, else that which holds the spawn data, else that among ManiSkill's assets.
        assets: asset pack with the homes and objects; "" for the built-in one if it has the homes, else ReplicaCAD
            among ManiSkill's assets.
        profile: see `config.profiles`.
    """

    plans: Sequence[MsHabTaskPlan]
    dataset: str
    subtask: str = ""
    spawn_file: Path | None = None
    root: Path | None = None
    assets: Any = ""
    profile: str = "ms_hab"


def check_plans(plans: Sequence[MsHabTaskPlan], subtask: str) -> None:
    """Check that plans are of a kind of subtask each, or of several subtasks if ``subtask`` is "".

    Raises:
        UsageError: there are none, or one is of another kind or length; the message names it.
    """
    if not plans:
        raise wrong_value("task_plans", [], "a list of one plan or more")
    first = [each.type for each in plans[0].subtasks]
    wanted = [subtask] if subtask else first
    for number, plan in enumerate(plans):
        kinds = [each.type for each in plan.subtasks]
        if kinds != wanted:
            raise wrong_value(
                f"task_plans[{number}].subtasks",
                kinds,
                f"{wanted}: "
                + (
                    f"the environment is of {subtask!r} alone, one subtask per plan"
                    if subtask
                    else "plans of parallel worlds have the same subtasks in the same order"
                ),
            )


def complete(request: PlanRequest) -> PlanRequest:
    """The request with data set, folder and assets."""
    first = request.plans[0]
    root = request.root or _rearrange_dir(first, request.spawn_file)
    dataset = request.dataset
    if not dataset:
        split, _, rest = str(first.init_config_name).partition("/")
        dataset = dataset_name(rest.partition("/")[0], split)
    assets = request.assets
    if not assets:
        known = open_pack(BUILTIN).homes_by_name
        fits = home_of(first.build_config_name) in known
        # Plans of the original name homes of ReplicaCAD, which the built-in pack lacks.
        other = REPLICA_CAD.is_dir() and not fits
        assets = str(REPLICA_CAD) if other else BUILTIN
    return dataclasses.replace(request, dataset=dataset, root=root, assets=assets)


def spawns_of(request: PlanRequest) -> list[Spawns]:
    """Spawns of every plan; empty for whole tasks."""
    if not request.subtask:
        return []
    if request.spawn_file is None:
        raise UsageError(
            f"a {request.subtask} alone needs spawn data: give spawn_data_fp, such as "
            f"spawn_data/<task>/{request.subtask}/<split>/spawn_data.pt.",
            option="spawn_data_fp",
        )
    known = read_spawn_data(request.spawn_file)
    uids = [plan.subtasks[0].uid for plan in request.plans]
    lacking = [uid for uid in uids if uid not in known]
    if lacking:
        raise fault(
            request.spawn_file,
            f"it has no spawns of {len(lacking)} of {len(uids)} plans ({_some(lacking)}); it has those of "
            f"{_some(list(known))}. Give the spawn data that were made for these plans.",
        )
    return [known[uid] for uid in uids]


def check_homes(request: PlanRequest, homes: Mapping[str, Any], pack: str) -> None:
    named = list(dict.fromkeys(home_of(plan.build_config_name) for plan in request.plans))
    lacking = [name for name in named if name not in homes]
    if lacking:
        raise wrong_value(
            "build_config_name",
            _some(lacking),
            f"a home of pack {pack!r}, such as {next(iter(homes))}",
            f"{len(lacking)} of the {len(named)} homes of these plans are missing: give the assets that the plans are "
            "for (assets=FOLDER of ReplicaCAD), or make plans of this pack with `mjhab episodes plans`.",
        )


def _some(names: Sequence[str]) -> str:
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _names_of(request: PlanRequest) -> list[str]:
    names = [plan.init_config_name or "" for plan in request.plans]
    for number, name in enumerate(names):
        if not name:
            raise wrong_value(
                f"task_plans[{number}].init_config_name", name, "the file of an episode"
            )
    return list(dict.fromkeys(names))


def _rearrange_dir(plan: MsHabTaskPlan, spawn_file: Path | None) -> Path:
    """The folder of rearrangement data that a plan belongs to.

    It is that from which its file was read, else that which holds the spawn data, else the one among the assets.
    """
    above = None if spawn_file is None else root_above(spawn_file, "spawn_data")
    return plan.root or above or REARRANGE


def root_of(request: PlanRequest) -> Path:
    assert request.root is not None
    return request.root


def episodes_of(request: PlanRequest) -> dict[str, HabEpisode]:
    return {name: read_init_config(root_of(request), name) for name in _names_of(request)}


def digest_of(request: PlanRequest) -> str:
    """Hash of everything that starts depend on besides the layout."""
    digest = hashlib.sha256()
    head = (_VERSION, __version__, request.dataset, request.subtask, request.profile)
    digest.update(repr((*head, str(request.assets))).encode())
    digest.update(json.dumps([dataclasses.asdict(p) for p in request.plans]).encode())
    if request.spawn_file is not None:
        digest.update(request.spawn_file.read_bytes())
    for name in _names_of(request):
        path = root_of(request) / name
        # A missing file is told where it is read, with the folder that should hold it.
        digest.update(path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest()[:24]
