"""Robust output streams: terminals limited to ASCII, closed pipes, full disks."""

from __future__ import annotations

import io
import os
import sys
import warnings
from typing import TextIO

from mjhab.core.files.reading import reason
from mjhab.core.registration.plugins import PluginWarning


def make_streams_sturdy() -> None:
    """Make streams escape characters that they cannot encode, and replace closed streams by null devices."""
    sys.stdout = sys.stdout or io.StringIO()
    sys.stderr = sys.stderr or io.StringIO()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def show_own_warnings_plainly() -> None:
    """Print warnings of mjhab as one line on stderr, without the place in its source that Python adds."""
    usual = warnings.showwarning

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, PluginWarning):
            print(message, file=file or sys.stderr)
        else:
            usual(message, category, filename, lineno, file, line)

    warnings.showwarning = show


def drop_unwritable_stdout() -> None:
    """If stdout cannot be written, discard its buffered output, so that the interpreter exits without an error."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())


def described(error: OSError) -> str:
    """Describe an OSError for the user."""
    if error.filename is None:
        return f"cannot write the output ({reason(error)})."
    return f"{error.filename} cannot be used ({reason(error)})."
