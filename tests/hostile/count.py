"""Counts what happens to every hostile input, each in a process of its own: ``python -m tests.hostile.count``."""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

from tests.hostile.cases import Case, cases
from tests.hostile.outcome import outcome

LIMIT_S = 30.0


def tried(case: Case) -> str:
    """The outcome of a case in a process of its own; "hang" after LIMIT_S."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    with tempfile.TemporaryDirectory() as folder:
        process = context.Process(target=_run, args=(case, Path(folder), there))
        process.start()
        there.close()
        found = here.poll(LIMIT_S)
        try:
            return str(here.recv()) if found else "hang"
        except EOFError:
            process.join()
            return f"died: {process.exitcode}"
        finally:
            process.kill()
            process.join()


def _run(case: Case, folder: Path, pipe: Connection) -> None:
    pipe.send(outcome(case, folder))


def count() -> None:
    """Print a line for every input that is not refused as it should be, and the counts."""
    groups: dict[str, Counter[str]] = {}
    for case in cases():
        found = tried(case)
        groups.setdefault(case.group, Counter())[found.partition(":")[0]] += 1
        if found != "clean":
            print(f"{found:10} | {case}", file=sys.stderr, flush=True)
    total: Counter[str] = Counter()
    for group, counts in groups.items():
        total += counts
        print(f"{group:12} {dict(counts)}")
    print(f"{'all':12} {dict(total)}")


if __name__ == "__main__":
    count()
