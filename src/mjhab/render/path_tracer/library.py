"""Mitsuba and its denoiser, the extra ``photo``: which variants a machine has, and one of them loaded."""

from __future__ import annotations

import functools
import glob
import os
import re
from types import ModuleType
from typing import Any

from mjhab.core.errors import UsageError
from mjhab.core.libraries import check_imports, require_libraries
from mjhab.scenes.shading import CUDA, LLVM, SCALAR

MODULES = ("mitsuba", "mitsuba_oidn")
LLVM_PATH = "DRJIT_LIBLLVM_PATH"
"""Variable of the environment with the path of the library."""
OLDEST_LLVM = 17
"""Mitsuba 3.9 ends the process in its first picture with LLVM 15 and 16, and refuses older ones."""


def mitsuba(variant: str) -> ModuleType:
    """Mitsuba with a variant of `shading.VARIANTS` set; "" takes `SCALAR`. A process keeps the variant it took first.

    Raises:
        UsageError: the extra is absent or broken, the machine lacks what the variant needs, or another is in use.
    """
    user = "shader 'path'"
    require_libraries(user, MODULES, "photo")
    check_imports(MODULES, "photo")
    variant = variant or SCALAR
    problem = _unavailable(variant)
    if problem:
        raise UsageError(
            f"{user}: variant {variant!r} {problem}; {SCALAR!r} runs anywhere.",
            option="variant",
            given=variant,
            expected=SCALAR,
        )
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    present = mi.variant()
    if present is not None and present != variant:
        raise UsageError(
            f"{user}: this process draws with variant {present!r}; take {variant!r} in a process of its own.",
            option="variant",
            given=variant,
            expected=present,
        )
    mi.set_variant(variant)
    return mi


def denoise(color: Any, albedo: Any, normal: Any, fast: bool) -> Any:
    """Intel's Open Image Denoise for linear light (h, w, 3) f32, with noise-free colours and normals of the surfaces.

    ``fast``: with the smaller of its networks, in half the time (40 of 73 ms of a core at 128 x 128); the difference
    is 0.1 dB. It takes edges from the light, too: those of colours that were drawn fast are not smoothed.
    """
    import mitsuba_oidn  # pyright: ignore[reportMissingImports]

    quality = mitsuba_oidn.Quality.Fast if fast else mitsuba_oidn.Quality.High
    return mitsuba_oidn.denoise(
        color,
        albedo=albedo,
        normal=normal,
        hdr=True,
        # Pictures that were drawn fast have hard edges, which are no clean guide.
        clean_aux=not fast,
        quality=quality,
    )


@functools.cache
def _unavailable(variant: str) -> str:
    """Why a variant cannot run here; "" if it can."""
    if variant == LLVM:
        return "" if _has_llvm() else f"needs LLVM {OLDEST_LLVM} or newer (libllvm19)"
    if variant == CUDA:
        return "" if _has_cuda() else "needs an NVIDIA GPU, and none is found"
    return ""


def _has_llvm() -> bool:
    """Whether Mitsuba can compile: with the library that it is told, else with the newest, which it is told here."""
    told = os.environ.get(LLVM_PATH, "")
    # drjit itself takes any version, also one that ends the process.
    path = told or max(glob.glob("/usr/lib/*/libLLVM*.so*"), key=_number, default="")
    if _number(path) < OLDEST_LLVM:
        return False
    # Before drjit is imported, which looks for the library then.
    os.environ[LLVM_PATH] = path
    import drjit  # pyright: ignore[reportMissingImports]

    return bool(drjit.has_backend(drjit.JitBackend.LLVM))


def _number(path: str) -> int:
    """The version in a name such as libLLVM.so.19.1 or libLLVM-17.so.1; 0 for none."""
    found = re.search(r"libLLVM[-.](?:so\.)?(\d+)", path)
    return int(found[1]) if found else 0


def _has_cuda() -> bool:
    import drjit  # pyright: ignore[reportMissingImports]

    return bool(drjit.has_backend(drjit.JitBackend.CUDA))
