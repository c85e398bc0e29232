"""Robust output streams: terminals limited to ASCII, closed pipes, full disks."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import warnings
from collections.abc import Iterator
from typing import Any, TextIO, cast

from mjhab.core.errors import MjhabError
from mjhab.core.files.outputs import DISK_ERRORS
from mjhab.core.files.reading import reason
from mjhab.core.registration.plugins import PluginWarning


class SturdyStream:
    """A text stream for messages: if the stream below cannot be written, it discards this text and all further text.

    Messages never end the work: the reader of stderr may leave (``2>&1 | head -1``), or its disk may be full.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write ``text`` or discard it; returns its number of characters."""
        try:
            return self._stream.write(text)
        except (OSError, ValueError):
            _discard_output(self._stream)
            return len(text)

    def flush(self) -> None:
        """Write what is buffered, or discard it."""
        try:
            self._stream.flush()
        except (OSError, ValueError):
            _discard_output(self._stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def make_streams_sturdy() -> None:
    """Make stdout and stderr usable whatever they lead to.

    Characters that they cannot encode are escaped, closed ones are replaced by null devices, and stderr discards what
    cannot be written.
    """
    _open_closed_descriptors()
    sys.stdout = sys.stdout or _null_device()
    sys.stderr = sys.stderr or _null_device()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # Tests call main several times in one process.
    if not isinstance(sys.stderr, SturdyStream):
        sys.stderr = cast(TextIO, SturdyStream(sys.stderr))


def _open_closed_descriptors() -> None:
    """Open the null device as stdin, stdout or stderr where they are closed: the next file would get their number."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _null_device() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")


def _discard_output(stream: TextIO) -> None:
    """Lead a stream that cannot be written to the null device, so that the interpreter exits without an error.

    A closed stream, or one without a descriptor, stays as it is.
    """
    try:
        number = stream.fileno()
    except (OSError, ValueError):
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    # The descriptor and not the object: libraries in C write to it, too.
    os.dup2(nowhere, number)
    os.close(nowhere)


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
        _discard_output(sys.stdout)


def described(error: OSError) -> str:
    """Describe an OSError for the user."""
    if error.filename is None:
        return f"cannot write the output ({reason(error)})."
    return f"{error.filename} cannot be used ({reason(error)})."


@contextlib.contextmanager
def with_way_on(advice: str) -> Iterator[None]:
    """Tell how to continue where a full or broken disk ends a command.

    Args:
        advice: sentence behind the description of the error.

    Raises:
        MjhabError: the disk is full or broken.
    """
    try:
        yield
    except OSError as error:
        # Without a file name it is the terminal or a pipe, and more space would not help.
        if error.errno not in DISK_ERRORS or error.filename is None:
            raise
        raise MjhabError(f"{described(error)} {advice}") from error
