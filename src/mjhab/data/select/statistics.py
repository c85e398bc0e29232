"""Normalization statistics of recorded episodes, with a file format to cache them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjhab.core.errors import unknown_name
from mjhab.core.files.arrays import open_arrays
from mjhab.core.files.cache import write_atomic

_FORMAT = "mjhab-statistics-1"
MAX_FILE_MB = 64
"""Largest file of statistics, unpacked; a real one has some kB."""
SPREAD = "spread"
RANGE = "range"
NORMALS = (SPREAD, RANGE)
"""Ways to normalize: to mean 0 and standard deviation 1, or to [-1, 1] (for diffusion policies)."""
_LEAST = 1e-3
"""Smallest scale to divide by, so that nearly constant columns are not amplified."""


@dataclass(frozen=True)
class Statistics:
    """Mean, standard deviation, minimum and maximum per column of arrays, each (D,) float32, by the array's name.

    ``fingerprint`` identifies the data that they were computed from.
    """

    mean: Mapping[str, np.ndarray]
    std: Mapping[str, np.ndarray]
    low: Mapping[str, np.ndarray]
    high: Mapping[str, np.ndarray]
    fingerprint: str = ""

    @classmethod
    def of(
        cls, arrays: Mapping[str, Sequence[np.ndarray]], fingerprint: str = ""
    ) -> Statistics:
        """Compute the statistics over all rows of lists of arrays (n, D), in float64."""
        parts: dict[str, dict[str, np.ndarray]] = {
            "mean": {},
            "std": {},
            "low": {},
            "high": {},
        }
        for name, pieces in arrays.items():
            count = sum(len(piece) for piece in pieces)
            # float32 sums over millions of rows lose the digits that the spread is made of.
            mean = sum(piece.sum(axis=0, dtype=np.float64) for piece in pieces) / count
            # In a second pass, since the mean of squares cancels where the mean is large.
            square = sum(((piece - mean) ** 2).sum(axis=0) for piece in pieces) / count
            parts["mean"][name] = np.asarray(mean, np.float32)
            parts["std"][name] = np.sqrt(square).astype(np.float32)
            parts["low"][name] = np.min(
                [piece.min(axis=0) for piece in pieces], axis=0
            ).astype(np.float32)
            parts["high"][name] = np.max(
                [piece.max(axis=0) for piece in pieces], axis=0
            ).astype(np.float32)
        return cls(**parts, fingerprint=fingerprint)

    def normalize(self, name: str, values: np.ndarray, how: str = SPREAD) -> np.ndarray:
        """Normalize values (..., D) to mean 0 and standard deviation 1, or with ``how`` = RANGE to [-1, 1].

        Raises:
            UsageError: ``how`` is not one of NORMALS.
        """
        centre, scale = self._frame(name, how)
        return ((values - centre) / scale).astype(np.float32)

    def restore(self, name: str, values: np.ndarray, how: str = SPREAD) -> np.ndarray:
        """Inverse of ``normalize``, (..., D)."""
        centre, scale = self._frame(name, how)
        return (values * scale + centre).astype(np.float32)

    def _frame(self, name: str, how: str) -> tuple[np.ndarray, np.ndarray]:
        if how not in NORMALS:
            raise unknown_name("way to normalize", str(how), NORMALS)
        if how == SPREAD:
            return self.mean[name], np.maximum(self.std[name], _LEAST)
        low = self.low[name]
        high = self.high[name]
        # Half the range, so that the ends are at -1 and 1.
        return (low + high) / 2, np.maximum((high - low) / 2, _LEAST)

    def save(self, path: Path) -> None:
        """Write the statistics atomically as npz without pickles."""
        arrays = {
            f"{part}/{name}": value
            for part in _PARTS
            for name, value in getattr(self, part).items()
        }
        head = np.frombuffer(
            json.dumps({"format": _FORMAT, "of": self.fingerprint}).encode(), np.uint8
        )

        def write(temporary: Path) -> None:
            with temporary.open("wb") as file:
                # A file object, because numpy appends .npz to a path.
                np.savez(file, head=head, **arrays)

        write_atomic(path, write)

    @classmethod
    def load(cls, path: Path) -> Statistics:
        """Read a file of ``save``.

        Raises:
            UsageError: the file does not exist or has another format.
        """
        parts: dict[str, dict[str, np.ndarray]] = {part: {} for part in _PARTS}
        remedy = "delete it to compute them again"
        with open_arrays(path, "file of statistics", MAX_FILE_MB, remedy) as file:
            head = json.loads(file["head"].tobytes())
            if not isinstance(head, dict) or head.get("format") != _FORMAT:
                raise ValueError("its format is another one")
            fingerprint = str(head["of"])
            for key in file:
                part, _, name = key.partition("/")
                if name:
                    parts[part][name] = file[key]
        return cls(**parts, fingerprint=fingerprint)


_PARTS = ("mean", "std", "low", "high")


def fingerprint(episodes: Iterable[tuple[str, str]]) -> str:
    """Hash of names and digests of episodes, in their order."""
    digest = hashlib.sha256()
    for name, content in episodes:
        digest.update(f"{name} {content}\n".encode())
    return digest.hexdigest()[:16]
