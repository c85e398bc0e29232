"""The extra that learning needs."""

from __future__ import annotations

from mjhab.core.errors import UsageError
from mjhab.core.libraries import check_imports, missing_libraries
from mjhab.core.machine import install_extra

LIBRARIES = ("torch", "safetensors", "tensorboard")
"""What the extra ``[learn]`` installs."""
IMPORTED = ("torch", "safetensors.torch")
"""What every policy and every training needs of it."""


def require_learn() -> None:
    """Check that the extra is installed and that torch can be imported.

    Raises:
        UsageError: a library is missing or broken; the message says how to install it.
    """
    missing = missing_libraries(LIBRARIES)
    if missing:
        raise UsageError(
            f"learning needs {', '.join(missing)}, which {'is' if len(missing) == 1 else 'are'} not installed. "
            f"Install the extra: {install_extra('learn')}"
        )
    check_imports(IMPORTED, "learn")
