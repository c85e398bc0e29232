"""Maps of where the base can stand, and of the ways between these places: MS-HAB's navigable positions.

``configs/scenes/<scene>.<robot>.navigable_positions.obj`` has the places, ``..._simplified.obj`` fewer of them, and
``..._simplified_all_pairs_dist.npy`` the lengths of the ways between those. In the original, spawns are drawn from the
first, and Navigate counts its way by the other two (mshab/envs/navigate.py). Vertices have two coordinates, world x, y.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.core.errors import fault, wrong_value
from mjhab.core.files.cache import write_atomic, write_text
from mjhab.core.files.reading import read_bytes
from mjhab.core.names import below
from mjhab.scenes.freespace import FreeMap

FOLDER = Path("configs", "scenes")
"""Below the data set in the original, beside "rearrange"; ours lie below the folder of plans."""
SPACING_M = 0.3
"""Distance of neighbouring places of the simplified map."""
MAX_MAP_MB = 1024
_STEM = "navigable_positions"
_REMEDY = "`mjhab episodes plans` writes such maps of mjhab's homes."


@dataclass(frozen=True, eq=False)
class NavigableMap:
    """Places (V, 2) [m] of a home, and the lengths (V, V) [m] of the ways between them."""

    places: np.ndarray
    ways: np.ndarray

    def nearest(self, xy: np.ndarray) -> tuple[int, float]:
        """Place nearest to ``xy`` (2,), and its distance [m]."""
        apart = np.linalg.norm(self.places - xy, axis=1)
        at = int(apart.argmin())
        return at, float(apart[at])


def map_paths(folder: Path, scene: str, robot: str = "fetch") -> tuple[Path, Path, Path]:
    """Files of a scene, such as "v3_sc0_staging_00.scene_instance": places, fewer places, ways between these."""
    stem = f"{scene.removesuffix('.json')}.{robot}.{_STEM}"
    ends = (".obj", "_simplified.obj", "_simplified_all_pairs_dist.npy")
    return tuple(below(folder, f"{stem}{end}") for end in ends)  # type: ignore[return-value]


def read_map(folder: Path, scene: str) -> NavigableMap | None:
    """Read the simplified map of a scene; None if neither of its files is there.

    Raises:
        UsageError: one of both is missing, or has another layout; the message names the file.
    """
    _, places_file, ways_file = map_paths(folder, scene)
    found = [path.is_file() for path in (places_file, ways_file)]
    if not any(found):
        return None
    if not all(found):
        there, missing = sorted(
            (places_file, ways_file), key=lambda path: not path.is_file()
        )
        raise fault(there, f"{missing.name}, which belongs to it, is missing. {_REMEDY}")
    places = _places(places_file)
    ways = _ways(ways_file)
    if ways.shape != (len(places), len(places)):
        raise wrong_value(
            "ways between places",
            ways.shape,
            f"({len(places)}, {len(places)}), as {places_file.name} has {len(places)} vertices",
            where=ways_file,
        )
    return NavigableMap(places, ways)


def read_maps(folders: Sequence[Path], scenes: Sequence[str]) -> dict[str, NavigableMap]:
    """Maps by scene, of the first folder that has one; scenes of which no folder has one are left out."""
    found = {}
    for scene in scenes:
        for folder in folders:
            one = read_map(folder, scene)
            if one is not None:
                found[scene] = one
                break
    return found


def write_map(folder: Path, scene: str, free: FreeMap) -> tuple[Path, Path, Path]:
    """Write the three files of a home; inverse of `read_map`."""
    paths = map_paths(folder, scene)
    every = free.navigable()
    step = max(1, round(SPACING_M / free.cell))
    cells, faces = _meshed(every[::step, ::step])
    cells = cells * step
    # Not strict: the third of the files holds lengths, and no mesh.
    for path, mesh in zip(paths, (_meshed(every), (cells, faces)), strict=False):
        text = _wavefront(free.to_xy(mesh[0]), mesh[1])
        write_text(path, text)
    ways = free.ways_between(cells)

    def save(temporary: Path) -> None:
        # Given a path, numpy would append .npy to it.
        with temporary.open("wb") as file:
            np.save(file, ways)

    write_atomic(paths[2], save)
    return paths


class MapWays:
    """Lengths of the ways of W worlds to their goals by such maps; takes the place of `envs.parts.NavDistance`.

    As in the original, the way from the base to its nearest place does not count.

    Args:
        maps: of the homes, by name. num_worlds: W.
    """

    def __init__(self, maps: Mapping[str, NavigableMap], num_worlds: int) -> None:
        self._maps = maps
        self._begun: list[tuple[NavigableMap, np.ndarray] | None] = [None] * num_worlds

    def begin(self, world: int, home: str, goal_xy: np.ndarray) -> None:
        """Set the goal (2,) [m] of a world."""
        known = self._maps[home]
        at, apart = known.nearest(np.asarray(goal_xy, float)[:2])
        self._begun[world] = (known, known.ways[:, at] + apart)

    def at(self, base_xy: np.ndarray) -> np.ndarray:
        """(W,) lengths [m] from base positions (W, 2); 0 in worlds without a goal."""
        return np.array(
            [
                0.0 if begun is None else begun[1][begun[0].nearest(xy)[0]]
                for begun, xy in zip(self._begun, base_xy, strict=True)
            ]
        )


def _meshed(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells (V, 2) of the squares that a mask (X, Y) fills, and triangles (F, 3) over them.

    Readers of such files keep no vertex without a triangle.
    """
    full = mask[:-1, :-1] & mask[1:, :-1] & mask[:-1, 1:] & mask[1:, 1:]
    used = np.zeros_like(mask)
    corners = np.argwhere(full)
    around = [corners + offset for offset in ((0, 0), (1, 0), (1, 1), (0, 1))]
    for corner in around:
        used[corner[:, 0], corner[:, 1]] = True
    number = np.cumsum(used.ravel()).reshape(mask.shape) - 1
    a, b, c, d = (number[corner[:, 0], corner[:, 1]] for corner in around)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return np.argwhere(used), faces


def _wavefront(places: np.ndarray, faces: np.ndarray) -> str:
    rows = [f"v {x:.6f} {y:.6f}" for x, y in places]
    rows += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    return "\n".join(rows) + "\n"


def _places(path: Path) -> np.ndarray:
    """Vertices (V, 2) of a Wavefront file."""
    rows = []
    # Comments of such a file may be in any encoding; only its numbers are read.
    text = read_bytes(path, MAX_MAP_MB).decode("utf-8", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        kind, *numbers = line.split() or [""]
        if kind != "v":
            continue
        try:
            rows.append([float(value) for value in numbers])
        except ValueError as error:
            raise fault(path, f"line {number} has no numbers: {line[:40]!r}.") from error
        if len(numbers) != 2:
            raise wrong_value(
                f"numbers of the vertex in line {number}",
                len(numbers),
                "2, world x and y",
                _REMEDY,
                where=path,
            )
    places = np.array(rows, float).reshape(-1, 2)
    if not len(places) or not np.isfinite(places).all():
        raise fault(path, f"it has no vertices, or some that are not finite. {_REMEDY}")
    return places


def _ways(path: Path) -> np.ndarray:
    """Lengths of a file of numpy's; one with Python objects, a pickle, is refused."""
    try:
        ways = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise fault(
            path, f"it is no array of numbers ({str(error).splitlines()[0]}). {_REMEDY}"
        ) from error
    if not isinstance(ways, np.ndarray) or ways.ndim != 2 or ways.dtype.kind not in "fiu":
        raise wrong_value(
            "ways between places",
            f"{ways.dtype} {ways.shape}"
            if isinstance(ways, np.ndarray)
            else "an archive",
            "numbers (places, places)",
            where=path,
        )
    # Infinity is a length, too: furniture can part two places.
    if np.isnan(ways).any() or (ways < 0).any():
        raise fault(path, "it has ways that are negative or no numbers.")
    return ways.astype(np.float32)
