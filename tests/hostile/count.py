"""Counts what happens to every hostile input, each in a process of its own: ``python -m tests.hostile.count``."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

from tests.hostile.cases import Case, cases
from tests.hostile.outcome import outcome

LIMIT_CPU_S = 12.0
LIMIT_S = 120.0
"""Processor time and wall time [s] after which a case counts as a hang; a loaded machine stretches the second."""


def tried(case: Case) -> str:
    """The outcome of a case in a process of its own; "hang" after the limits."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    with tempfile.TemporaryDirectory() as folder:
        process = context.Process(target=_run, args=(case, Path(folder), there))
        process.start()
        assert process.pid
        there.close()
        begun = time.monotonic()
        while not here.poll(0.1):
            if _cpu_s(process.pid) > LIMIT_CPU_S or time.monotonic() - begun > LIMIT_S:
                return "hang"
        try:
            return str(here.recv())
        except EOFError:
            process.join()
            return f"died: {process.exitcode}"
        finally:
            # Workers that the case started, too.
            with contextlib.suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
            process.join()


def _cpu_s(process: int | None) -> float:
    """Processor time of a process [s]; 0 once it is gone."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _run(case: Case, folder: Path, pipe: Connection) -> None:
    os.setsid()
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
