"""Libraries of extras: whether they are there, and whether they can be imported."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Sequence

from mjhab.core.errors import UsageError
from mjhab.core.files.reading import reason
from mjhab.core.machine import install_extra


def missing_libraries(names: Sequence[str]) -> list[str]:
    """Those of the names that are not installed; nothing is imported."""
    return [name for name in names if not _is_installed(name)]


def missing_library(user: str, names: Sequence[str], install: str) -> UsageError:
    """Build the error for libraries that are not installed.

    Args:
        user: what needs them, an option or a function: "--ray", "learning".
        names: of the libraries.
        install: the command that installs them, see `core.machine.install_extra`.
    """
    verb = "is" if len(names) == 1 else "are"
    return UsageError(
        f"{user} needs {', '.join(names)}, which {verb} not installed. Install with: {install}",
        option=user,
        expected=tuple(names),
    )


def require_libraries(user: str, names: Sequence[str], extra: str) -> None:
    """Check that the libraries of an extra are installed; nothing is imported. See `missing_library`.

    Raises:
        UsageError: one is not.
    """
    missing = missing_libraries(names)
    if missing:
        raise missing_library(user, missing, install_extra(extra))


def check_imports(names: Sequence[str], extra: str) -> None:
    """Import libraries that are installed.

    Args:
        names: of the modules.
        extra: of mjhab that installs them.

    Raises:
        UsageError: an import fails, for instance since a shared library is absent or of another version; the message
            says why and how to install the extra again.
    """
    for name in names:
        try:
            importlib.import_module(name)
        # Compiled libraries fail in many ways: OSError, ImportError, RuntimeError, AttributeError.
        except Exception as error:
            raise UsageError(
                f"{name} is installed but cannot be imported ({type(error).__name__}: {reason(error)}). Install it "
                f"again: {install_extra(extra)}"
            ) from error


def _is_installed(name: str) -> bool:
    try:
        # Found, not imported: torch takes seconds to load.
        return importlib.util.find_spec(name) is not None
    except ValueError:  # an imported module whose __spec__ is None
        return True
