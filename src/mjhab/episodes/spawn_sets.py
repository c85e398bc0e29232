"""Spawn sets: files of precomputed starts, valid for the layout they were made for.

A file is an ``.npz`` without pickles: a JSON header and columns with one row per start, which hold everything that an
environment needs to start without settling objects or searching spawns. Columns of n starts with T targets:

- ``home`` (n,): name of the home
- ``qpos`` (n, nq): start state
- ``object_pose`` (n, N, 7): object poses of the episode, world frame [m, wxyz]
- ``link_q`` (n, L): joint positions of drawers and doors of the episode [m or rad]
- ``position`` (n,): position of the subtask in its chain
- ``fallback`` (n,) bool: the spawn is that of `SpawnSampler.fallback`
- ``tries`` (n,): sampled spawns
- ``targets`` (n, T, 3): names of the object, of the link it starts behind, of the link of its goal
- ``points`` (n, T, 3, 3): world positions of goal, start and handle [m]
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError, about, fault
from mjhab.core.files.arrays import open_arrays
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.reading import is_file, parse_json
from mjhab.core.names import check_name
from mjhab.core.seeding import stream
from mjhab.core.typed.options import read_record
from mjhab.core.version import __version__
from mjhab.episodes.episode import Episode
from mjhab.layout.compile import home_hash
from mjhab.layout.layout import Layout
from mjhab.robots.registry import DEFAULT_ROBOT
from mjhab.scenes.pack_check import MAX_POSITION_M, check_range
from mjhab.scenes.spec import JOINT_DYNAMICS, OWN_DYNAMICS, Vec3
from mjhab.tasks.plan import Target

FORMAT = "mjhab-spawns-1"
MAX_SET_MB = 2048
"""Largest unpacked size of a set [MB]: about half a million starts."""
_MB = 2**20
_MAX_COLUMNS_BYTES = (MAX_SET_MB - 1) * _MB
"""The rest is for the header."""
_HEADER = {
    "recipe": dict[str, Any],
    "pack": str,
    "layout": str,
    "grasps": dict[str, str],
    "versions": dict[str, str],
    "digest": str,
}
"""Fields of a header and their types."""
SPAWNS_SUFFIX = ".npz"
_COLUMNS = (
    "home",
    "qpos",
    "object_pose",
    "link_q",
    "position",
    "fallback",
    "tries",
    "targets",
    "points",
)

_DIMENSIONS = {"qpos": 2, "object_pose": 3, "link_q": 2, "targets": 3, "points": 4}
"""Number of dimensions by column; 1 for all others."""
_LAST_AXES = {"object_pose": (7,), "targets": (3,), "points": (3, 3)}
"""Required sizes of the last axes by column."""
_KINDS = {
    "home": "U",
    "qpos": "f",
    "object_pose": "f",
    "link_q": "f",
    "fallback": "b",
    "targets": "U",
    "points": "f",
}
"""``dtype.kind`` by column; all others hold integers."""


@dataclass(frozen=True)
class SpawnRecipe:
    """Content of a spawn set: start i is that of episode (seed, i).

    Attributes:
        task: household task.
        subtask: subtask of the starts; "" for whole chains.
        target: object type, object or link of the subtask; "" for any.
        split: split of homes.
        seed: seed of the episodes.
        count: number of starts.
        assets: asset pack.
        home: name or pattern of homes; "" for all of the split.
        pool: with n > 0, start i has the home and object poses of episode i modulo n; with 0, of episode i.
        harvested: starts with a held object also use the grasps that were added on this machine.
        spawn_rule: see `profiles.Profile`.
        robot: name of the robot.
        joint_dynamics: of the furniture, see `EnvConfig`; sets that do not tell theirs have "ours".
    """

    task: str
    subtask: str
    target: str
    split: str
    seed: int
    count: int
    assets: str | dict[str, Any] = "builtin"
    home: str = ""
    pool: int = 0
    harvested: bool = False
    spawn_rule: str = "front_box"
    robot: str = DEFAULT_ROBOT
    joint_dynamics: str = OWN_DYNAMICS


@dataclass(frozen=True, eq=False)
class SpawnRow:
    """One start: its episode, the state (nq,), and how the spawn was found (fields as in `starts.Start`)."""

    episode: Episode
    qpos: np.ndarray
    position: int
    fallback: bool
    tries: int


def layout_digest(layout: Layout) -> str:
    """Return the hash of a layout's homes, objects, robot and compiling code; starts are valid where it is equal."""
    homes = layout.pack.homes
    # The first home stands for what all share: objects, robot and code.
    return hashlib.sha256(
        repr((home_hash(layout, homes[0]), homes)).encode()
    ).hexdigest()[:16]


def header_of(
    recipe: SpawnRecipe, layout: Layout, grasps: dict[str, str]
) -> dict[str, Any]:
    """Return the header of a file. ``grasps``: hash of the grasps that starts were drawn from, by object type."""
    made_by = {
        "mjhab": __version__,
        **{name: version(name) for name in ("mujoco", "numpy")},
    }
    return {
        "format": FORMAT,
        "recipe": asdict(recipe),
        "pack": layout.pack.name,
        "layout": layout_digest(layout),
        "grasps": grasps,
        "versions": made_by,
        **({"stage": layout.stage} if layout.stage else {}),
    }


def pack_rows(rows: Sequence[SpawnRow]) -> dict[str, np.ndarray]:
    """Return the columns of a file, see the module, from at least one start."""
    targets = [row.episode.targets for row in rows]
    return {
        "home": np.array([row.episode.home for row in rows]),
        "qpos": np.array([row.qpos for row in rows]),
        "object_pose": np.array([row.episode.object_pose for row in rows]),
        "link_q": np.array([row.episode.link_q for row in rows]),
        "position": np.array([row.position for row in rows]),
        "fallback": np.array([row.fallback for row in rows]),
        "tries": np.array([row.tries for row in rows]),
        "targets": np.array(
            [[(t.obj, t.start_link, t.goal_link) for t in own] for own in targets]
        ),
        "points": np.array(
            [[(t.goal_pos, t.start_pos, t.handle_pos) for t in own] for own in targets]
        ),
    }


def join(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenate the columns of several files."""
    return {name: np.concatenate([part[name] for part in parts]) for name in _COLUMNS}


def check_size(columns: dict[str, np.ndarray], count: int) -> None:
    """Check that a set can be read again.

    Args:
        columns: starts of it, at least one.
        count: number of starts that it will have.

    Raises:
        UsageError: that many starts are larger than `MAX_SET_MB`; the message says how many fit.
    """
    rows = len(columns["home"])
    row_bytes = sum(column.nbytes for column in columns.values()) / rows
    # A set that its reader refuses must not be made.
    fitting = int(_MAX_COLUMNS_BYTES / row_bytes)
    if count > fitting:
        raise UsageError(
            f"a spawn set of {count:,} starts takes {count * row_bytes / _MB:,.0f} MB, and at most {MAX_SET_MB:,} MB "
            f"are read: make at most {fitting:,} starts, or several sets of other seeds."
        )


def write(path: Path, header: dict[str, Any], columns: dict[str, np.ndarray]) -> SpawnSet:
    """Add the digest to the header, write the set atomically and return it.

    Raises:
        UsageError: it is larger than `MAX_SET_MB`.
    """
    check_size(columns, len(columns["home"]))
    # The digest is of the header without it.
    header = {**header, "digest": content_digest(header, columns)}
    text = np.array(json.dumps(header))
    write_atomic(
        path,
        lambda temporary: np.savez_compressed(
            temporary, allow_pickle=False, header=text, **columns
        ),
    )
    return SpawnSet(path, header, columns)


def content_digest(header: dict[str, Any], columns: dict[str, np.ndarray]) -> str:
    """Return the hash of header and columns.

    The path of the assets is left out; the header has a hash of their content.
    """
    recipe = {name: value for name, value in header["recipe"].items() if name != "assets"}
    digest = hashlib.sha256(
        json.dumps({**header, "recipe": recipe}, sort_keys=True).encode()
    )
    for name in _COLUMNS:
        digest.update(
            # Type and shape as well: the same bytes could be read as another array.
            repr((name, columns[name].dtype.str, columns[name].shape)).encode()
            + columns[name].tobytes()
        )
    return digest.hexdigest()[:16]


def _read_header(text: str) -> dict[str, Any]:
    """Parse and check the header of a set.

    Raises:
        ValueError: a field is missing or has the wrong type; the message names it.
    """
    header = parse_json(text)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"its format is not {FORMAT}")
    # Field by field, so that a message names the one that is wrong.
    for name, kind in _HEADER.items():
        read_record(kind, header.get(name), f"header.{name}")
    recipe = header["recipe"]
    known = {field.name for field in fields(SpawnRecipe)}
    read_record(
        SpawnRecipe,
        {name: recipe[name] for name in recipe if name in known - {"assets"}},
        "header.recipe",
    )
    if not isinstance(recipe.get("assets", ""), str | dict):
        raise ValueError("header.recipe.assets: expected a name or an object.")
    # Seeds are hashed as natural numbers; a negative one would fail at the first draw.
    if recipe["seed"] < 0:
        raise ValueError(
            f"header.recipe.seed: expected a number from 0, got {recipe['seed']}."
        )
    for name in ("task", "split"):
        check_name(f"recipe, {name}", recipe[name])
    for name in ("subtask", "target"):
        check_name(f"recipe, {name}", recipe[name], empty=True)
    check_name("recipe, robot", recipe.get("robot", DEFAULT_ROBOT))
    joints = recipe.get("joint_dynamics", OWN_DYNAMICS)
    if joints not in JOINT_DYNAMICS:
        raise ValueError(
            f"header.recipe.joint_dynamics: expected {' or '.join(JOINT_DYNAMICS)}, got {joints!r}."
        )
    return header


def _check_content(columns: dict[str, np.ndarray]) -> None:
    """Check names, shapes, types and ranges of the columns. The digest does not ensure them: anyone can compute it.

    Raises:
        ValueError: the message names the column.
    """
    count = columns["home"].size
    for name in _COLUMNS:
        column = columns[name]
        last = _LAST_AXES.get(name, ())
        fits = (
            column.ndim == _DIMENSIONS.get(name, 1)
            and column.shape[column.ndim - len(last) :] == last
        )
        if not fits or len(column) != count or not count:
            raise ValueError(
                f"column {name!r} has shape {column.shape}, which does not fit {count} starts."
            )
        if column.dtype.kind not in _KINDS.get(name, "iu"):
            raise ValueError(f"column {name!r} is {column.dtype}.")
        if column.dtype.kind == "f" and not np.isfinite(column).all():
            raise ValueError(f"column {name!r} has numbers that are not finite.")
    # Names reach file names and the terminal, and a file may come from anywhere.
    for name in set(columns["home"].tolist()):
        check_name("column 'home'", name)
    for name in set(columns["targets"].ravel().tolist()):
        check_name("column 'targets'", name, empty=True)
    if columns["targets"].shape[1] != columns["points"].shape[1]:
        raise ValueError(
            "columns 'targets' and 'points' are of different numbers of targets."
        )
    for name in ("object_pose", "points"):
        check_range(
            f"column {name!r}",
            columns[name][..., :3],
            -MAX_POSITION_M,
            MAX_POSITION_M,
            "m",
        )


def _misfit(columns: dict[str, np.ndarray], layout: Layout) -> str:
    """Return how columns do not fit a layout (sizes, names), "" if they fit; the file's digest may be forged."""
    objects = len(layout.roster)
    links = len(layout.links)
    numbers = {
        "object_pose": objects,
        "link_q": links,
        "qpos": len(layout.robot.joints) + links + 7 * objects,
    }
    for name, wanted in numbers.items():
        if columns[name].shape[1] != wanted:
            return f"column {name!r} has {columns[name].shape[1]} entries instead of {wanted}"
    targets = columns["targets"]
    named = {
        "home": (columns["home"], layout.pack.homes_by_name),
        "object": (targets[..., 0], layout.object_names),
        "link": (targets[..., 1:], ("", *layout.link_ids)),
    }
    for what, (column, known) in named.items():
        unknown = set(column.ravel().tolist()).difference(known)
        if unknown:
            return f"there is no {what} {min(unknown)!r}"
    return ""


class SpawnSet:
    """A spawn set. ``header``: fields of `header_of`, and ``digest``; ``columns``: arrays by name, see the module."""

    def __init__(
        self, path: Path, header: dict[str, Any], columns: dict[str, np.ndarray]
    ) -> None:
        self.path = path
        self.header = header
        self.columns = columns

    @classmethod
    def read(cls, path: Path) -> SpawnSet:
        """Read a file without checking its layout.

        Raises:
            UsageError: there is no such file, it is not a spawn set, or it is damaged.
        """
        if not is_file(path):
            raise UsageError(
                f"there is no file {path}; `mjhab spawns make --out {path}` makes one."
            )
        with open_arrays(path, "spawn set", MAX_SET_MB) as data:
            header = _read_header(str(data["header"]))
            columns = {name: data[name] for name in _COLUMNS}
            stated = header.pop("digest")
            # Before the content is looked at: a torn file is to be called torn.
            if content_digest(header, columns) != stated:
                raise ValueError("its content is not what its header says")
        with about(path, advice="Make it again."):
            _check_content(columns)
        return cls(path, {**header, "digest": stated}, columns)

    @classmethod
    def load(cls, path: Path, layout: Layout) -> SpawnSet:
        """Read a file and check that it was made for a layout.

        Raises:
            UsageError: as in `read`, or it was made for another robot or layout.
        """
        found = cls.read(path)
        made_for = found.recipe.robot
        robot = layout.robot.name
        # Compared first, as the digest of the layout would differ for a reason that the user could not see.
        if made_for != robot:
            raise fault(
                path,
                f"holds starts of robot {made_for!r}, the environment has robot {robot!r}. Set "
                f"robot={made_for!r}, or make a set with `mjhab spawns make --robot {robot}`.",
            )
        here = layout_digest(layout)
        if found.header["layout"] != here:
            versions = found.header["versions"]
            made = (
                f"pack {found.header['pack']!r}, mjhab {versions.get('mjhab', 'unknown')}"
            )
            theirs = f"{found.header['layout']} ({made})"
            raise fault(
                path,
                f"was made for layout {theirs}; this is layout {here} (pack {layout.pack.name!r}, mjhab "
                f"{__version__}): homes, objects or the code that compiles them differ. Make it again with `mjhab "
                "spawns make`, or open the assets it was made for.",
            )
        wrong = _misfit(found.columns, layout)
        if wrong:
            raise fault(path, f"does not fit its layout: {wrong}. Make it again.")
        return found

    def __len__(self) -> int:
        return len(self.columns["home"])

    @property
    def digest(self) -> str:
        """Hash of header and starts, for manifests."""
        return self.header["digest"]

    @cached_property
    def recipe(self) -> SpawnRecipe:
        """The recipe that the set was made from."""
        known = {field.name for field in fields(SpawnRecipe)}
        return SpawnRecipe(
            **{
                name: value
                for name, value in self.header["recipe"].items()
                if name in known
            }
        )

    @property
    def homes(self) -> tuple[str, ...]:
        """Sorted names of the homes of the starts."""
        return tuple(sorted(set(self.columns["home"].tolist())))

    @property
    def fallbacks(self) -> int:
        """Number of starts whose spawn is a fallback."""
        return int(self.columns["fallback"].sum())

    def describe(self) -> dict[str, Any]:
        """Return a summary of the set for a table or a manifest."""
        return {
            "file": str(self.path),
            **asdict(self.recipe),
            "count": len(self),
            "homes": len(self.homes),
            "fallbacks": self.fallbacks,
            "tries_mean": round(float(self.columns["tries"].mean()), 3),
            "pack": self.header["pack"],
            "layout": self.header["layout"],
            **({"stage": self.header["stage"]} if "stage" in self.header else {}),
            "digest": self.digest,
        }

    def check(self, config: EnvConfig) -> None:
        """Check that the set was made for task, subtask, target, split, home, spawn rule and joints of a configuration.

        Raises:
            UsageError: one differs; the message names it.
        """
        for name in (
            "task",
            "subtask",
            "target",
            "split",
            "home",
            "spawn_rule",
            "joint_dynamics",
        ):
            made = getattr(self.recipe, name)
            wanted = getattr(config, name)
            if made != wanted:
                raise fault(
                    self.path,
                    f"holds starts with {name} {made!r}, the environment has {name} {wanted!r}. Set "
                    f"{name}={made!r}, or make a set with `mjhab spawns make`.",
                )

    def number(self, index: int) -> int:
        """Return the row of episode ``index``: the same number if there is one, else a random one seeded by it."""
        return (
            index
            if index < len(self)
            else int(stream(self.recipe.seed, "spawn set", index).integers(len(self)))
        )

    def row(self, index: int, seed: int | None = None) -> SpawnRow:
        """Return the start of episode (``seed``, ``index``); None is the set's seed."""
        k = self.number(index)
        rows = self.columns
        episode = Episode(
            self.recipe.seed if seed is None else seed,
            index,
            self.recipe.task,
            self.recipe.split,
            str(rows["home"][k]),
            rows["object_pose"][k],
            rows["link_q"][k],
            self._targets(k),
        )
        # The caller changes it.
        qpos = rows["qpos"][k].copy()
        return SpawnRow(
            episode,
            qpos,
            int(rows["position"][k]),
            bool(rows["fallback"][k]),
            int(rows["tries"][k]),
        )

    def episode(self, seed: int, index: int) -> Episode:
        """Return the episode of start ``index`` with the given seed, as `EpisodeMaker.episode` does."""
        return self.row(index, seed).episode

    def _targets(self, k: int) -> tuple[Target, ...]:
        return tuple(
            Target(
                str(obj),
                _point(goal),
                _point(start_pos),
                str(start),
                str(where),
                _point(handle),
            )
            for (obj, start, where), (goal, start_pos, handle) in zip(
                self.columns["targets"][k], self.columns["points"][k], strict=True
            )
        )


def _point(row: np.ndarray) -> Vec3:
    x, y, z = row.tolist()
    return (x, y, z)
