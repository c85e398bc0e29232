"""Telling our files from others, and this version of the schema from others."""

from __future__ import annotations

from pathlib import Path

import h5py

from mjhab.core.errors import UsageError
from mjhab.data.schema import EPISODES, FORMAT, RUNS, VERSION, DamagedError


def check_format(file: h5py.File, path: Path) -> None:
    """Refuse files that this version of mjhab cannot read.

    Raises:
        DamagedError: some other HDF5 file, or one that lost its parts.
        UsageError: a shard of another schema version; the message says how to read it.
    """
    if file.attrs.get("format") != FORMAT:
        names = ", ".join(list(file)[:4]) or "nothing"
        raise DamagedError(
            f"{path} is an HDF5 file, but holds no episodes of mjhab (it holds {names}). Sets in the layout of ManiSkill "
            "or LeRobot are read with their own tools; mjhab writes them from shards."
        )
    version = int(file.attrs.get("schema", 0))
    if version != VERSION:
        maker = str(file.attrs.get("mjhab", "?"))
        raise UsageError(
            f"{path} has schema {version} and was written by mjhab {maker}; this mjhab reads schema {VERSION}. "
            + (
                f"Install mjhab {maker} or newer to read it."
                if version > VERSION
                else f"Replay it into a new shard with mjhab {maker}'s successor that reads {version}, or record anew."
            )
        )
    missing = [name for name in (EPISODES, RUNS) if name not in file]
    if missing:
        raise DamagedError(f"{path} has lost its group {missing[0]!r}. Try: mjhab data repair {path}")
