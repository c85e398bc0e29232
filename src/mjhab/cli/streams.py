"""What commands print to: terminals that know ASCII only, pipes that are closed, disks that are full."""

from __future__ import annotations

import io
import os
import sys

from mjhab.core.files.reading import reason


def make_streams_sturdy() -> None:
    """Print what a stream cannot encode as escapes, and nothing where a stream was closed."""
    sys.stdout = sys.stdout or io.StringIO()
    sys.stderr = sys.stderr or io.StringIO()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def drop_unwritable_stdout() -> None:
    """Send what is still to be printed nowhere if stdout cannot be written, so that the interpreter ends quietly."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())


def described(error: OSError) -> str:
    """What the system refused, in words."""
    if error.filename is None:
        return f"cannot write the output ({reason(error)})."
    return f"{error.filename} cannot be used ({reason(error)})."
