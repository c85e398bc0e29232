"""The extra that learning needs."""

from __future__ import annotations

from mjhab.core.libraries import check_imports, require_libraries

LIBRARIES = ("torch", "safetensors", "tensorboard")
"""What the extra ``[learn]`` installs."""
IMPORTED = ("torch", "safetensors.torch")
"""What every policy and every training needs of it."""


def require_learn() -> None:
    """Check that the extra is installed and that torch can be imported.

    Raises:
        UsageError: a library is missing or broken; the message says how to install it.
    """
    require_libraries("learning", LIBRARIES, "learn")
    check_imports(IMPORTED, "learn")
