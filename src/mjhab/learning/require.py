"""The extra that learning needs."""

from __future__ import annotations

import importlib.util

from mjhab.core.errors import UsageError
from mjhab.core.machine import install_extra

LIBRARIES = ("torch", "safetensors", "tensorboard")
"""What the extra ``[learn]`` installs."""


def require_learn() -> None:
    """Check that the extra is installed, without importing it.

    Raises:
        UsageError: a library is missing; the message says how to install it.
    """
    missing = [name for name in LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(
            f"learning needs {', '.join(missing)}, which {'is' if len(missing) == 1 else 'are'} not installed. "
            f"Install the extra: {install_extra('learn')}"
        )
