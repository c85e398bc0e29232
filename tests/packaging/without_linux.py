"""Program: mjhab without what only Linux has: modules, functions of os and signal, and /proc.

Imports every module, evaluates, generates and locks; prints "done" at the end.
"""

from __future__ import annotations

import builtins
import contextlib
import importlib
import io
import os
import pkgutil
import signal
import sys
from pathlib import Path
from typing import Any

MODULES = ("fcntl", "resource", "pwd", "grp", "termios")
# platformdirs asks for getuid on every system that is not Windows.
OF_OS = """sched_getaffinity sched_setaffinity fork forkpty getloadavg killpg setsid getpgid statvfs mkfifo
posix_fadvise sendfile chown nice""".split()
OF_SIGNAL = """SIGKILL SIGHUP SIGUSR1 SIGUSR2 SIGALRM SIGCHLD pthread_kill pthread_sigmask setitimer alarm""".split()
OPTIONAL = ("vla_eval", "mitsuba", "lerobot")
"""Packages that need not be installed."""


def take_away() -> None:
    """Let all that be absent."""
    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for owner, names in ((os, OF_OS), (signal, OF_SIGNAL)):
        for name in names:
            with contextlib.suppress(AttributeError):
                delattr(owner, name)
    opened = io.open

    def without_proc(file: Any, *args: Any, **options: Any) -> Any:
        if str(file).startswith("/proc"):
            raise FileNotFoundError(2, "there is no /proc", str(file))
        return opened(file, *args, **options)

    builtins.open = io.open = without_proc


def import_all() -> None:
    """Import every module of mjhab."""
    import mjhab

    for module in pkgutil.walk_packages(mjhab.__path__, "mjhab."):
        if ".examples." in module.name or module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            if str(error.name).split(".")[0] not in OPTIONAL:
                raise


def work(folder: Path) -> None:
    """Evaluate, generate, and take a lock twice."""
    from mjhab.cli.main import main
    from mjhab.core.errors import UsageError
    from mjhab.core.files.locking import WriteLock

    common = "--policy zero --subtask close --episodes 1 --horizon 5 --threads 1"
    evaluation = f"eval {common} --films 0 --out {folder / 'run'}"
    assert main(evaluation.split()) == 0
    assert main(f"generate {common} --keep true --out {folder / 'data'}".split()) == 0
    assert main(["data", "stats", str(folder / "data")]) == 0
    with WriteLock(folder / "file"):
        try:
            WriteLock(folder / "file").__enter__()
        except UsageError:
            return
    raise AssertionError("a lock was taken twice")


if __name__ == "__main__":
    take_away()
    import_all()
    work(Path(sys.argv[1]))
    print("done")
