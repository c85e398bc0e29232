"""What happened to a hostile input."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

from mjhab.core.errors import MjhabError
from tests.hostile.cases import Case

REFUSED = (1, 2)
MAX_MESSAGE_LINES = 20
"""The box of the parser has 13 to 17 lines; all others have one."""
MAX_MESSAGE_CHARACTERS = 2_000


def outcome(case: Case, folder: Path) -> str:
    """ "clean", "accepted", "wordy", "wrote" or the name of an exception that is none of ours."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            code = case.act(folder)
    except MjhabError as error:
        return _judged(str(error), folder)
    except Exception as error:
        return f"traceback: {type(error).__name__}: {str(error)[:80]}"
    if not isinstance(code, int) or code not in REFUSED:
        return "accepted"
    return _judged(said.getvalue(), folder)


def _judged(message: str, folder: Path) -> str:
    if "Traceback" in message:
        return "traceback"
    if (folder / "new").exists():
        return "wrote"
    lines = [line for line in message.splitlines() if line.strip()]
    if len(lines) > MAX_MESSAGE_LINES or len(message) > MAX_MESSAGE_CHARACTERS:
        return "wordy"
    return "clean"
