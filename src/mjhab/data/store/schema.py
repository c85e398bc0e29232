"""The schema of shards: names, shapes, units of datasets; its version. `docs/data/format.md` shows this table."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjhab.core.errors import MjhabError

FORMAT = "mjhab-episodes"
"""Root attribute ``format``, which identifies a shard."""
VERSION = 4
"""Schema version: root attribute ``schema`` of a file, and attribute of each episode. It increases with every change
that older readers could not read or would misread. Adding optional datasets, attributes or JSON keys does not increase
it, because readers ignore unknown names.

1: the first version. 2: adds intended actions and actors; quaternions in observations are canonical. 3: observations of
profile "ms_hab" have poses of objects in the axes of their scans; runs tell their `core.conventions.names`. 4: each
recorded episode is a file of its own until a set is packed; files are never changed in place."""
OLDEST = 1
"""Oldest supported schema version; `Episode` converts older content to that of VERSION."""
EPISODES = "episodes"
RUNS = "runs"

STORED_CHECKS: tuple[str, ...] = (
    "is_grasped",
    "at_goal",
    "ee_rest",
    "robot_rest",
    "is_static",
    "force_ok",
    "opened",
    "closed",
    "slightly_opened",
    "slightly_closed",
    "near",
    "oriented",
    "contact",
    "touch",
    "success",
    "placed_ok",
    "must_hold",
    "ee_contact",
)
"""Columns of ``signals/checks``: the boolean fields of `tasks.measure.Signals`, which suffice to compute labels.
Older shards lack the last column, ``ee_contact``, see ``checks_by_name``."""
FORCES: tuple[str, ...] = ("robot_force", "target_force", "cumulative_force")
"""Columns of ``signals/forces``: the float fields of `tasks.measure.Signals`."""
COLUMNS = "columns"
"""Attribute of a two-dimensional dataset: names of its columns, joined by commas; "name:n" stands for n columns."""
ENDINGS = ("success", "force_exceeded", "place_broken", "timeout", "cut")
"""How an episode can end; "cut" by its caller."""
TERMINAL = frozenset({"success", "force_exceeded", "place_broken"})
"""Endings for which the environment returned "terminated"; the others are truncations."""


@dataclass(frozen=True)
class Field:
    """One dataset of an episode.

    rows: number of rows: "N" control steps, "N+1" states, "K" subtasks reached, "" for any. since: first schema version
    that has it.
    """

    path: str
    rows: str
    shape: str
    dtype: str
    unit: str
    meaning: str
    optional: bool = False
    since: int = 1


def _fields(table: str) -> tuple[Field, ...]:
    """Read a table: since, path ("?": optional), rows, shape, type, unit, meaning."""
    cells = [
        [cell.strip() for cell in row.split("|")] for row in table.strip().splitlines()
    ]
    return tuple(
        Field(
            path.rstrip("?"),
            rows,
            shape,
            dtype,
            unit,
            meaning,
            path.endswith("?"),
            int(since),
        )
        for since, path, rows, shape, dtype, unit, meaning in cells
    )


FIELDS = _fields("""
1 | record           |     | bytes | uint8 | JSON | the `EpisodeRecord`: identity, plan, labels, events, forces, taint
1 | actions          | N   | (N, A) | float32 | action table | as executed, before clipping
2 | actions_intended | N   | (N, A) | float32 | action table | what was intended: without noise
2 | actor            | N   | (N,) | uint8 | index in `actors` | who acted
1 | states/initial   |     | bytes | uint8 | JSON | `env.get_state` after the reset: the full first state
1 | states/qpos?     | N+1 | (N+1, nq) | float64 | m, rad, wxyz | generalized positions
1 | states/qvel?     | N+1 | (N+1, nv) | float64 | m/s, rad/s | generalized velocities
1 | signals/checks   | N+1 | (N+1, 18) | uint8 | 0 or 1 | STORED_CHECKS of the subtask that was active in the step
1 | signals/forces   | N+1 | (N+1, 3) | float64 | N, N, N x steps | FORCES, likewise
1 | signals/taint    | N+1 | (N+1,) | uint8 | bit mask | faults of the simulation since the reset
1 | subtasks/active  | N+1 | (N+1,) | int16 | index in the plan | subtask active after the step
1 | subtasks/step    | K   | (K,) | int32 | control steps | when each subtask that was reached began
1 | subtasks/index   | K   | (K,) | int16 | index in the plan | which subtask it was
1 | subtasks/checks  | K   | (K, 18) | uint8 | 0 or 1 | STORED_CHECKS at its start: row 0 of its history
1 | reward/total     | N   | (N,) | float64 | - | what the environment returned
1 | reward/terms?    | N   | (N, R) | float64 | - | terms of the dense reward, as named
1 | reward/success   | N   | (N,) | uint8 | 0 or 1 | `info['success']` of every step
1 | reward/fail      | N   | (N,) | uint8 | 0 or 1 | `info['fail']` of every step
1 | obs/state        | N+1 | (N+1, D) | float32 | see columns | all state observations, side by side
1 | obs/*?           | N+1 | (N+1, ...) | any | see the observation table | any other observation
1 | images/*/bytes?  |     | bytes | uint8 | PNG or JPEG | encoded frames, one after another
4 | annotations?     |     | bytes | uint8 | JSON | skills of who acted, wordings of the instructions (`Annotations`)
1 | images/*/ends?   | N+1 | (N+1,) | int64 | bytes | where each frame ends in them
""")
"""Every dataset of an episode group; N actions, N+1 states, K subtasks reached, A action size."""

_ATTRIBUTES: dict[str, tuple[type, str]] = {
    "seed": (int, "seed of the episode"),
    "index": (int, "index of the episode: (config, seed, index) is its identity"),
    "run": (str, "name under `/runs` of what made it"),
    "home": (str, "home it happened in"),
    "model": (str, "hash of the compiled home: sizes, poses, masses, servos"),
    "label": (str, "label of the last subtask that ended"),
    "success": (bool, "whether the goal was reached at least once"),
    "steps": (int, "number N of control steps"),
    "ending": (
        str,
        f"how it ended: {', '.join(ENDINGS[:-1])}, or {ENDINGS[-1]} (by the caller)",
    ),
    "style": (
        str,
        "JSON: how the expert was asked to act in this episode; empty if nothing was asked",
    ),
    "actors": (str, "JSON: the names that the numbers of `actor` stand for"),
    "schema": (
        int,
        "version of the schema that the episode was recorded in; 1 where it is missing",
    ),
    "digest": (str, "SHA-256 over the record and every dataset"),
}
ATTRIBUTES = {name: meaning for name, (_, meaning) in _ATTRIBUTES.items()}
"""Attributes of an episode group: their meaning."""
ATTRIBUTE_TYPES = {name: kind for name, (kind, _) in _ATTRIBUTES.items()}
NEEDED_ATTRIBUTES = ("run", "steps", "ending", "digest")
"""Attributes without which an episode cannot be read."""


class DamagedError(MjhabError):
    """A file is damaged or has an unexpected format."""


def field_of(path: str) -> Field | None:
    """The entry of FIELDS for a dataset of an episode; None if there is none."""
    for field in FIELDS:
        if field.path == path:
            return field
    # Cameras and observations have names of their own, which no table can list.
    parts = path.split("/")
    if parts[0] == "obs" and len(parts) > 1:
        return next(f for f in FIELDS if f.path == "obs/*")
    if parts[0] == "images" and len(parts) == 4:
        return next((f for f in FIELDS if f.path == f"images/*/{parts[-1]}"), None)
    return None


def column_widths(
    layout: Mapping[str, Any], columns: Mapping[str, Sequence[str]]
) -> dict[str, int]:
    """Number of columns that datasets must have, by path.

    Args:
        layout: of the run, see `RunInfo`; sizes that it lacks are not checked.
        columns: names of the columns by path; "name:n" stands for n of them.
    """
    widths = {
        path: sum(_width(name) for name in names)
        for path, names in columns.items()
        if names
    }
    if "actions" in layout:
        widths["actions"] = len(layout["actions"])
        widths["actions_intended"] = len(layout["actions"])
    for name, size in layout.get("sizes", {}).items():
        widths[f"states/{name}"] = int(size)
    return widths


def _width(name: str) -> int:
    _, colon, count = name.rpartition(":")
    return int(count) if colon else 1


def checks_by_name(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Split ``signals/checks`` or ``subtasks/checks`` (n, C) into (n, 1) bool arrays by the names of STORED_CHECKS.

    If ``ee_contact`` was not recorded, ``touch`` (contact of any link) replaces it, as in the labels of that version.
    """
    table = {
        name: rows[:, column : column + 1].astype(bool)
        for column, name in enumerate(STORED_CHECKS)
    }
    # Shards recorded before the column was added have the others in the same order.
    if rows.shape[1] < len(STORED_CHECKS):
        table["ee_contact"] = table["touch"]
    return table


def problems(
    arrays: Mapping[str, np.ndarray],
    steps: int,
    others: bool = False,
    schema: int = VERSION,
    widths: Mapping[str, int] | None = None,
    absent: Collection[str] = (),
) -> list[str]:
    """Describe how the datasets of an episode violate the schema; empty if they do not.

    Every required field must exist with its type and shape, N actions need N+1 states, and all numbers must be finite.

    Args:
        arrays: every dataset by its path.
        steps: number N of actions.
        others: allow datasets outside this schema, which a later version may have added.
        schema: version of the episode.
        widths: number of columns by path, from `column_widths`.
        absent: paths of fields that the source of the episode did not have (`RunInfo.absent`).
    """
    needed = [
        field.path for field in FIELDS if not field.optional and field.since <= schema
    ]
    found = [
        f"{path} is missing"
        for path in needed
        if path not in arrays and path not in absent
    ]
    if steps < 1:
        found.append(f"an episode has at least one action, not {steps}")
    count = len(arrays["subtasks/step"]) if np.ndim(arrays.get("subtasks/step", 0)) else 0
    rows = {"N": steps, "N+1": steps + 1, "K": count}
    for path, array in arrays.items():
        field = field_of(path)
        if field is None:
            # Readers let unknown ones pass, since later versions may add some; writers do not.
            found += [] if others else [f"{path} is not part of the schema"]
            continue
        if field.dtype != "any" and array.dtype != np.dtype(field.dtype):
            found.append(f"{path} is {array.dtype}, not {field.dtype}")
        elif not _has_dimensions(field, array):
            found.append(f"{path} has shape {array.shape}, not {field.shape}")
        elif field.rows and len(array) != rows[field.rows]:
            wanted = f"{rows[field.rows]} ({field.rows} with N = {steps} actions)"
            found.append(f"{path} has {len(array)} rows, not {wanted}")
        elif (
            widths
            and array.ndim == 2
            and array.shape[1] != widths.get(path, array.shape[1])
        ):
            found.append(f"{path} has {array.shape[1]} columns, not {widths[path]}")
        # Last of these, because it reads the whole array.
        elif array.dtype.kind == "f" and not np.isfinite(array).all():
            found.append(_not_finite(path, array))
    # Values are only compared where types and shapes hold.
    return found or _bad_values(arrays, steps)


def _has_dimensions(field: Field, array: np.ndarray) -> bool:
    """Whether an array has the number of dimensions of its field's shape: "(N, A)", "(N+1, ...)" or "bytes"."""
    sizes = [size for size in field.shape.strip("()").split(",") if size.strip()]
    return array.ndim >= 1 if "..." in field.shape else array.ndim == len(sizes)


def _not_finite(path: str, array: np.ndarray) -> str:
    bad = ~np.isfinite(array)
    first = [int(k) for k in np.argwhere(bad)[0]]
    return f"{path} has {int(bad.sum())} numbers that are not finite, the first one ({array[bad][0]}) at {first}"


def _bad_values(arrays: Mapping[str, np.ndarray], steps: int) -> list[str]:
    found = []
    for path, columns in (
        ("signals/checks", STORED_CHECKS),
        ("signals/forces", FORCES),
        ("subtasks/checks", STORED_CHECKS),
    ):
        widths = (
            # Shards of before ``ee_contact`` have a column less.
            (len(columns), len(columns) - 1)
            if columns is STORED_CHECKS
            else (len(columns),)
        )
        if path in arrays and (
            arrays[path].ndim != 2 or arrays[path].shape[1] not in widths
        ):
            found.append(
                f"{path} has shape {arrays[path].shape}, not {len(columns)} columns"
            )
    if (
        "actions_intended" in arrays
        and arrays["actions_intended"].shape != arrays["actions"].shape
    ):
        found.append(
            f"actions_intended is {arrays['actions_intended'].shape}, actions are {arrays['actions'].shape}"
        )
    starts = arrays["subtasks/step"]
    if (
        not len(starts)
        or starts[0] != 0
        or (np.diff(starts) <= 0).any()
        or starts[-1] > steps
    ):
        found.append(f"subtasks/step must begin with 0, grow, and not exceed N = {steps}")
    for path, ends in arrays.items():
        if path.endswith("/ends") and path.startswith("images/"):
            data = arrays.get(path.removesuffix("ends") + "bytes")
            fits = data is not None and ends[0] > 0 and ends[-1] == len(data)
            if not fits or (np.diff(ends) <= 0).any():
                found.append(f"{path} does not fit its bytes")
    return found
