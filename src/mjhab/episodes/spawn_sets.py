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
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.core.errors import UsageError
from mjhab.core.files.cache import write_atomic
from mjhab.core.files.reading import parse_json
from mjhab.core.names import check_name
from mjhab.core.seeding import stream
from mjhab.core.version import __version__
from mjhab.episodes.generator import Episode
from mjhab.layout.compile import home_hash
from mjhab.layout.layout import Layout
from mjhab.scenes.pack_check import MAX_POSITION_M, check_range
from mjhab.scenes.spec import Vec3
from mjhab.tasks.plan import Target

FORMAT = "mjhab-spawns-1"
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
    header = {**header, "digest": _content(header, columns)}
    text = np.array(json.dumps(header))
    write_atomic(
        path,
        lambda temporary: np.savez_compressed(
            temporary, allow_pickle=False, header=text, **columns
        ),
    )
    return SpawnSet(path, header, columns)


def _content(header: dict[str, Any], columns: dict[str, np.ndarray]) -> str:
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


def _check_content(header: dict[str, Any], columns: dict[str, np.ndarray]) -> None:
    """Refuse invalid names and columns of different lengths. The digest does not exclude them: anyone can compute it.

    Raises:
        ValueError, KeyError, TypeError: the message names the entry.
    """
    recipe = header["recipe"]
    for name in ("task", "split"):
        check_name(f"recipe, {name}", recipe[name])
    for name in ("subtask", "target"):
        check_name(f"recipe, {name}", recipe[name], empty=True)
    count = len(columns["home"])
    for name in _COLUMNS:
        column = columns[name]
        if column.ndim != _DIMENSIONS.get(name, 1) or len(column) != count or not count:
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
    for name in ("object_pose", "points"):
        check_range(
            f"column {name!r}", columns[name][..., :3], -MAX_POSITION_M, MAX_POSITION_M, "m"
        )


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
        try:
            with np.load(path, allow_pickle=False) as data:
                header = parse_json(str(data["header"]))
                if not isinstance(header, dict) or header.get("format") != FORMAT:
                    raise KeyError(f"format {FORMAT}")
                columns = {name: data[name] for name in _COLUMNS}
            stated = header.pop("digest")
            sound = _content(header, columns) == stated
        # What is cut off or overwritten shows as any of these.
        except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
            raise UsageError(
                f"{path} is no spawn set, or is damaged ({error}); make it again."
            ) from error
        if not sound:
            raise UsageError(
                f"{path} is damaged: its content is not what its header says; make it again."
            )
        try:
            _check_content(header, columns)
        except (ValueError, KeyError, TypeError) as error:
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
            made = f"pack {found.header['pack']!r}, mjhab {found.header['versions']['mjhab']}"
            theirs = f"{found.header['layout']} ({made})"
            raise UsageError(
                f"{path} was made for layout {theirs}; this is layout {here} (pack {layout.pack.name!r}, mjhab "
                f"{__version__}): homes, objects or the code that compiles them differ. Make it again with `mjhab "
                "spawns make`, or open the assets it was made for."
            )
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
