"""Files of precomputed starts: made once, used by many runs, bound to the layout they were made for.

A file is an ``.npz`` without pickles: a header in JSON and one row per start, with everything an environment needs, so
that nothing has to be settled or searched again. Rows: ``home`` (n,), ``qpos`` (n, nq), ``object_pose`` (n, N, 7) and
``link_q`` (n, L) of the arrangement, ``position`` (n,) of the subtask in its chain, ``fallback`` (n,) bool, ``tries``
(n,), ``targets`` (n, T, 3) names (object, link it starts behind, link of its goal), ``points`` (n, T, 3, 3) goal, start
and handle.
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
from mjhab.core.errors import UsageError
from mjhab.core.files.arrays import open_arrays
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.reading import parse_json
from mjhab.core.names import check_name
from mjhab.core.seeding import stream
from mjhab.core.typed.records import read_record
from mjhab.core.version import __version__
from mjhab.episodes.generator import Episode
from mjhab.layout.compile import home_hash
from mjhab.layout.layout import Layout
from mjhab.scenes.pack_check import MAX_POSITION_M, check_range
from mjhab.scenes.spec import Vec3
from mjhab.tasks.plan import Target

FORMAT = "mjhab-spawns-1"
MAX_SET_MB = 2048
"""Largest set [MB], unpacked: about half a million starts."""
_HEADER = {
    "recipe": dict[str, Any],
    "pack": str,
    "layout": str,
    "grasps": dict[str, str],
    "versions": dict[str, str],
    "digest": str,
}
"""Fields of a header and their types."""
SUFFIX = ".npz"
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
"""Dimensions of the columns; the others have one."""
_LAST_AXES = {"object_pose": (7,), "targets": (3,), "points": (3, 3)}
"""Sizes of the last axes of the columns; the others have any."""
_KINDS = {
    "home": "U",
    "qpos": "f",
    "object_pose": "f",
    "link_q": "f",
    "fallback": "b",
    "targets": "U",
    "points": "f",
}
"""Kinds of the columns as numpy names them; the others hold whole numbers."""


@dataclass(frozen=True)
class SpawnRecipe:
    """What a set holds: start i is that of episode (seed, i) of a subtask ("" for whole chains) and target.

    ``pool``: 0 gives every start an arrangement of objects of its own; n lets start i have arrangement i modulo n.
    ``harvested``: placing begins with the grasps, too, that were added on this machine. ``spawn_rule``: see
    `profiles.Profile`.
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


@dataclass(frozen=True, eq=False)
class SpawnRow:
    """One start: the episode it belongs to, the state (nq,), and how it was found (see `starts.Start`)."""

    episode: Episode
    qpos: np.ndarray
    position: int
    fallback: bool
    tries: int


def layout_digest(layout: Layout) -> str:
    """Hash of all homes, objects and the code that compiles them: equal when a state means the same."""
    homes = layout.pack.homes
    return hashlib.sha256(repr((home_hash(layout, homes[0]), homes)).encode()).hexdigest()[:16]


def header_of(recipe: SpawnRecipe, layout: Layout, grasps: dict[str, str]) -> dict[str, Any]:
    """What a file says about itself. ``grasps``: object type to hash of the grasps its starts were drawn from."""
    made_by = {"mjhab": __version__, **{name: version(name) for name in ("mujoco", "numpy")}}
    return {
        "format": FORMAT,
        "recipe": asdict(recipe),
        "pack": layout.pack.name,
        "layout": layout_digest(layout),
        "grasps": grasps,
        "versions": made_by,
    }


def pack_rows(rows: Sequence[SpawnRow]) -> dict[str, np.ndarray]:
    """The columns of a file from at least one start."""
    targets = [row.episode.targets for row in rows]
    return {
        "home": np.array([row.episode.home for row in rows]),
        "qpos": np.array([row.qpos for row in rows]),
        "object_pose": np.array([row.episode.object_pose for row in rows]),
        "link_q": np.array([row.episode.link_q for row in rows]),
        "position": np.array([row.position for row in rows]),
        "fallback": np.array([row.fallback for row in rows]),
        "tries": np.array([row.tries for row in rows]),
        "targets": np.array([[(t.obj, t.start_link, t.goal_link) for t in own] for own in targets]),
        "points": np.array(
            [[(t.goal_pos, t.start_pos, t.handle_pos) for t in own] for own in targets]
        ),
    }


def join(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Columns of several files in one."""
    return {name: np.concatenate([part[name] for part in parts]) for name in _COLUMNS}


def write(path: Path, header: dict[str, Any], columns: dict[str, np.ndarray]) -> SpawnSet:
    """Write a set atomically and return it."""
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
    """Hash of the content of a set. It does not depend on the paths of the file and of the assets, whose hash is in the
    header."""
    recipe = {name: value for name, value in header["recipe"].items() if name != "assets"}
    digest = hashlib.sha256(json.dumps({**header, "recipe": recipe}, sort_keys=True).encode())
    for name in _COLUMNS:
        digest.update(
            repr((name, columns[name].dtype.str, columns[name].shape)).encode()
            + columns[name].tobytes()
        )
    return digest.hexdigest()[:16]


def _read_header(text: str) -> dict[str, Any]:
    """The header of a set.

    Raises:
        ValueError: a field is missing or does not fit; the message names it.
    """
    header = parse_json(text)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"its format is not {FORMAT}")
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
    if recipe["seed"] < 0:
        raise ValueError(f"header.recipe.seed: expected a number from 0, got {recipe['seed']}.")
    for name in ("task", "split"):
        check_name(f"recipe, {name}", recipe[name])
    for name in ("subtask", "target"):
        check_name(f"recipe, {name}", recipe[name], empty=True)
    return header


def _check_content(columns: dict[str, np.ndarray]) -> None:
    """Refuse invalid names and columns that do not fit together. The digest does not exclude them: anyone can
    compute it.

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
    for name in set(columns["home"].tolist()):
        check_name("column 'home'", name)
    for name in set(columns["targets"].ravel().tolist()):
        check_name("column 'targets'", name, empty=True)
    if columns["targets"].shape[1] != columns["points"].shape[1]:
        raise ValueError("columns 'targets' and 'points' are of different numbers of targets.")
    for name in ("object_pose", "points"):
        check_range(
            f"column {name!r}", columns[name][..., :3], -MAX_POSITION_M, MAX_POSITION_M, "m"
        )


def _misfit(columns: dict[str, np.ndarray], layout: Layout) -> str:
    """What in columns a layout does not have although its digest is the same, which anyone can write; "" if nothing."""
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
    """Starts from a file. ``header``: what `header_of` says, and ``digest``; ``columns``: the rows, see above."""

    def __init__(self, path: Path, header: dict[str, Any], columns: dict[str, np.ndarray]) -> None:
        self.path = path
        self.header = header
        self.columns = columns

    @classmethod
    def read(cls, path: Path) -> SpawnSet:
        """Read a file, whatever layout it was made for.

        Raises:
            UsageError: there is no such file, or it is no spawn set, or it is damaged.
        """
        if not path.is_file():
            raise UsageError(
                f"there is no file {path}; `mjhab spawns make --out {path}` makes one."
            )
        with open_arrays(path, "spawn set", MAX_SET_MB) as data:
            header = _read_header(str(data["header"]))
            columns = {name: data[name] for name in _COLUMNS}
            stated = header.pop("digest", "")
            if content_digest(header, columns) != stated:
                raise ValueError("its content is not what its header says")
        try:
            _check_content(columns)
        except ValueError as error:
            raise UsageError(f"{path}: {error} Make it again.") from error
        return cls(path, {**header, "digest": stated}, columns)

    @classmethod
    def load(cls, path: Path, layout: Layout) -> SpawnSet:
        """Read a file for use with a layout.

        Raises:
            UsageError: as `read`, or it was made for another layout.
        """
        found = cls.read(path)
        here = layout_digest(layout)
        if found.header["layout"] != here:
            versions = found.header["versions"]
            made = f"pack {found.header['pack']!r}, mjhab {versions.get('mjhab', 'unknown')}"
            theirs = f"{found.header['layout']} ({made})"
            raise UsageError(
                f"{path} was made for layout {theirs}; this is layout {here} (pack {layout.pack.name!r}, mjhab "
                f"{__version__}): homes, objects or the code that compiles them differ. Make it again with `mjhab "
                "spawns make`, or open the assets it was made for."
            )
        wrong = _misfit(found.columns, layout)
        if wrong:
            raise UsageError(f"{path} does not fit its layout: {wrong}. Make it again.")
        return found

    def __len__(self) -> int:
        return len(self.columns["home"])

    @property
    def digest(self) -> str:
        """Hash of header and starts, for manifests: equal sets give equal runs."""
        return self.header["digest"]

    @cached_property
    def recipe(self) -> SpawnRecipe:
        """What the set was made from."""
        known = {field.name for field in fields(SpawnRecipe)}
        return SpawnRecipe(
            **{name: value for name, value in self.header["recipe"].items() if name in known}
        )

    @property
    def homes(self) -> tuple[str, ...]:
        """Names of the homes that occur."""
        return tuple(sorted(set(self.columns["home"].tolist())))

    @property
    def fallbacks(self) -> int:
        """How many starts are places taken for want of a better one."""
        return int(self.columns["fallback"].sum())

    def describe(self) -> dict[str, Any]:
        """Numbers and names for a table or a manifest."""
        return {
            "file": str(self.path),
            **asdict(self.recipe),
            "count": len(self),
            "homes": len(self.homes),
            "fallbacks": self.fallbacks,
            "tries_mean": round(float(self.columns["tries"].mean()), 3),
            "pack": self.header["pack"],
            "layout": self.header["layout"],
            "digest": self.digest,
        }

    def check(self, config: EnvConfig) -> None:
        """Refuse an environment that is to do something else than what the starts are for.

        Raises:
            UsageError: names what differs.
        """
        for name in ("task", "subtask", "target", "split", "home", "spawn_rule"):
            made = getattr(self.recipe, name)
            wanted = getattr(config, name)
            if made != wanted:
                raise UsageError(
                    f"{self.path} holds starts with {name} {made!r}, the environment has {name} {wanted!r}. Set "
                    f"{name}={made!r}, or make a set with `mjhab spawns make`."
                )

    def number(self, index: int) -> int:
        """The row of episode ``index``: the same number while there are rows, else one drawn by the index."""
        return (
            index
            if index < len(self)
            else int(stream(self.recipe.seed, "spawn set", index).integers(len(self)))
        )

    def row(self, index: int, seed: int | None = None) -> SpawnRow:
        """The start of episode ``index``; its episode is named by (``seed``, index), by default the set's seed."""
        k = self.number(index)
        rows = self.columns
        episode = Episode(
            self.recipe.task,
            self.recipe.split,
            self.recipe.seed if seed is None else seed,
            index,
            str(rows["home"][k]),
            rows["object_pose"][k],
            rows["link_q"][k],
            self._targets(k),
        )
        qpos = rows["qpos"][k].copy()
        return SpawnRow(
            episode,
            qpos,
            int(rows["position"][k]),
            bool(rows["fallback"][k]),
            int(rows["tries"][k]),
        )

    def episode(self, seed: int, index: int) -> Episode:
        """The episode that start ``index`` belongs to, as `EpisodeMaker.episode` would name it."""
        return self.row(index, seed).episode

    def _targets(self, k: int) -> tuple[Target, ...]:
        return tuple(
            Target(
                str(obj), _point(goal), _point(start_pos), str(start), str(where), _point(handle)
            )
            for (obj, start, where), (goal, start_pos, handle) in zip(
                self.columns["targets"][k], self.columns["points"][k], strict=True
            )
        )


def _point(row: np.ndarray) -> Vec3:
    x, y, z = row.tolist()
    return (x, y, z)
