"""How commands end: the exit codes, and what is said of work that was stopped."""

from __future__ import annotations

import sys

OK = 0
FAILED = 1
USAGE = 2
INTERRUPTED = 130
BROKEN_PIPE = 141
"""Exit code of a process that SIGPIPE ended, as shells report it (128 + 13)."""
WITH_RESUME = " with --resume"


def stopped(kept: str, again: str = WITH_RESUME, does: str = "continues") -> int:
    """Tell on stderr what Ctrl-C or SIGTERM has left, and how to go on; returns the exit code.

    Args:
        kept: what is kept and where, without a full stop.
        again: how the same command is run again; "" for as it is.
        does: what it does then.
    """
    # Not by `say`, which would import more than `--help` needs.
    print(f"mjhab: interrupted; {kept}. The same command{again} {does}.", file=sys.stderr)
    return INTERRUPTED
