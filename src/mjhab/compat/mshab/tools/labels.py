"""Labels of recorded episodes, under the name and arguments of ``mshab.utils.label_dataset``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjhab.compat.mshab.tools.trees import to_numpy
from mjhab.core.errors import missing_field, wrong_value
from mjhab.data.imports.ms_hab_layout import to_events, to_verbose
from mjhab.tasks.label_state import History
from mjhab.tasks.labelling.legacy import legacy_events, legacy_history
from mjhab.tasks.subtasks.registry import name_of

KINDS = 5
"""Kinds of subtasks that the published rules know; larger numbers say that a plan is finished."""
AJAR = 0.1
"""Open: share of the range at which a joint counts as slightly opened."""
MOVED = 0.05
"""Close: share of the range that a joint has moved to count as slightly closed."""


def get_episode_label_and_events(
    task_cfgs: Mapping[str, Any], ep_success: Any, ep_infos: Mapping[str, Any]
) -> tuple[str | None, list[str], list[list[Any]]]:
    """Label an episode of one subtask by the published rules.

    Args:
        task_cfgs: limits by kind of subtask (``env.unwrapped.task_cfgs``).
        ep_success: (T,) bool, success after every action.
        ep_infos: entries (T,) of `info` after every action; ``add_event_tracker_info`` makes them complete.

    Returns:
        The label, the events that determine it, and all events with their steps and forces.

    Raises:
        UsageError: the episode has several kinds of subtasks, or an entry is missing.
    """
    infos = {name: np.asarray(to_numpy(values)) for name, values in ep_infos.items()}
    success = np.asarray(to_numpy(ep_success)).astype(bool)
    types = _entry(infos, "subtask_type")
    kinds = np.unique(types[types < KINDS])
    if len(kinds) != 1:
        raise wrong_value("subtask_type", kinds.tolist(), "of one subtask")
    kind = int(kinds[0])
    limit = task_cfgs[name_of(kind)].robot_cumulative_force_limit
    rows = _rows(kind, success, infos, limit)
    history = History(**{name: _from_start(values) for name, values in rows.items()})
    label = legacy_history(kind, history)[0]
    events = legacy_events(kind, history)[0]
    force = [round(float(f), 2) for f in _entry(infos, "robot_force")]
    return label, to_events(name_of(kind), events), to_verbose(events, force)


def _entry(infos: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    if name not in infos:
        raise missing_field(
            name, "info", "Make the environment with add_event_tracker_info=True."
        )
    return infos[name]


def _rows(
    kind: int, success: np.ndarray, infos: Mapping[str, np.ndarray], limit: float
) -> dict[str, np.ndarray]:
    """Signals (T,) by their names in a `History`; what the kind has none of is False."""
    no = np.zeros_like(success)
    rows = {name: no for name in History.__dataclass_fields__}
    rows["success"] = success
    rows["is_grasped"] = _entry(infos, "is_grasped")
    rows["force_ok"] = _entry(infos, "robot_cumulative_force") < limit
    name = name_of(kind)
    if name in ("pick", "open", "close"):
        touched = _entry(infos, "robot_target_pairwise_force") > 0
        rows |= {"contact": touched, "touch": touched, "ee_contact": touched}
    if name == "place":
        rows["at_goal"] = _entry(infos, "obj_at_goal")
    if name == "navigate":
        rows["near"] = _entry(infos, "navigated_close")
    if name in ("open", "close"):
        q = _entry(infos, "handle_active_joint_qpos")
        low = _entry(infos, "handle_active_joint_qmin")
        span = _entry(infos, "handle_active_joint_qmax") - low
        rows["slightly_opened"] = q - low > AJAR * span
        rows["slightly_closed"] = q[0] - q > MOVED * span
    if name == "open":
        rows["opened"] = _entry(infos, "articulation_open")
    if name == "close":
        rows["closed"] = _entry(infos, "articulation_closed")
    return rows


def _from_start(values: np.ndarray) -> np.ndarray:
    """(T+1, 1) bool with a row for the start, which the published rules do not look at."""
    column = values.astype(bool)[:, None]
    return np.concatenate([column[:1], column])
