"""Reads changed copies of files for a while: ``python -m tests.hostile.fuzz SECONDS [READER ...]``.

Every exception that is none of ours is printed once, with the seed of its copy, which is kept in the folder of
``MJHAB_FUZZ``, if that is set.
"""

from __future__ import annotations

import os
import random
import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from mjhab.core.errors import MjhabError
from tests.hostile.readers import READERS, Reader

SLOW_S = 5.0
MEMORY_BYTES = 8 * 2**30


def fuzz(name: str, reader: Reader, seconds: float, folder: Path) -> Counter[str]:
    """Read changed copies for ``seconds``; counts of what happened."""
    raw = reader.make(folder)
    path = folder / reader.file
    counts: Counter[str] = Counter()
    seen: set[tuple[str, str, int | None]] = set()
    seed = 0
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        seed += 1
        data = reader.changed(raw, random.Random(f"{name}{seed}"))
        path.write_bytes(data)
        before = time.monotonic()
        try:
            reader.read(path)
            counts["read"] += 1
        except MjhabError:
            counts["refused"] += 1
        except Exception as error:
            counts["traceback"] += 1
            last = traceback.extract_tb(error.__traceback__)[-1]
            found = (type(error).__name__, last.filename, last.lineno)
            if found not in seen:
                seen.add(found)
                _tell(name, seed, error, data)
        if time.monotonic() - before > SLOW_S:
            counts["slow"] += 1
            print(f"  slow: {name}, seed {seed}", flush=True)
            _keep(name, seed, data)
    return counts


def _tell(name: str, seed: int, error: Exception, data: bytes) -> None:
    frames = traceback.extract_tb(error.__traceback__)[-4:]
    way = ", ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in frames)
    print(
        f"  {name}, seed {seed}: {type(error).__name__}: {str(error)[:100]} ({way})",
        flush=True,
    )
    _keep(name, seed, data)


def _keep(name: str, seed: int, data: bytes) -> None:
    kept = os.environ.get("MJHAB_FUZZ")
    if kept:
        Path(kept, f"{name.replace(' ', '_')}_{seed}").write_bytes(data)


def main() -> None:
    """Fuzz the readers that are named, or all."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    seconds = float(sys.argv[1])
    for name in sys.argv[2:] or READERS:
        with tempfile.TemporaryDirectory() as folder:
            print(
                name, dict(fuzz(name, READERS[name], seconds, Path(folder))), flush=True
            )


if __name__ == "__main__":
    main()
