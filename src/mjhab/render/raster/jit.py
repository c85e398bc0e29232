"""How the kernels of the rasterizer are compiled, and kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

from mjhab.core.code_digest import code_digest

KERNEL_MODULES = (
    "render.raster.jit",
    "render.raster.lighting",
    "render.raster.occlusion",
    "render.raster.batch",
    "render.raster.fill",
    "render.raster.kernels",
    "render.raster.shading",
    "render.patterns",
    "render.textures",
)
"""Modules whose code or constants go into kernels."""
_DIGEST = code_digest(*KERNEL_MODULES).hex()[:8]


def _compiler(**extra: Any) -> Callable[[Callable[..., Any]], Any]:
    # ``_nrt`` off: the kernels make no arrays (see ``kernels.Scratch``), and counting references costs time.
    options: dict[str, Any] = {
        "nogil": True,
        "cache": True,
        "error_model": "numpy",
        "_nrt": False,
    } | extra

    def decorate(function: Callable[..., Any]) -> Any:
        # Numba renews a compiled function only when its own file changes, not for helpers or constants of another one,
        # and fails on files of older code whose types are gone. The name is part of the file's name.
        function.__qualname__ = f"{function.__qualname__}_{_DIGEST}"
        return njit(**options)(function)

    return decorate


kernel = _compiler()
inline = _compiler(forceinline=True)
"""For helpers called per triangle or per pixel: a call would copy every array descriptor it is given."""
color_kernel = _compiler(fastmath=True)
"""For colours. Not for edges and depths, which must come out alike for the two triangles at an edge."""
color_inline = _compiler(forceinline=True, fastmath=True)
