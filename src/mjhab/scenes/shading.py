"""How pictures of homes are made: the shader, and the options of the one that traces paths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.typed.bounds import Bound
from mjhab.core.typed.options import take_options

RASTER = "raster"
PATH = "path"
SHADERS = (RASTER, PATH)
MIDDAY = "midday"
EVENING = "evening"
LIGHTS = (MIDDAY, EVENING)
SCALAR = "scalar_rgb"
LLVM = "llvm_ad_rgb"
CUDA = "cuda_ad_rgb"
VARIANTS = (SCALAR, LLVM, CUDA)


@dataclass(frozen=True)
class Shading:
    """Options of the shader "path"."""

    samples: Annotated[int, Bound(1, 4096)] = 4
    """Paths per pixel. Their noise goes with the square root of it; the denoiser takes what is left."""
    light: str = MIDDAY
    """"midday": sun and sky through the windows, lamps dim; "evening": dusk outside, lamps bright."""
    variant: str = ""
    """Mitsuba's variant: scalar_rgb (the default, anywhere), llvm_ad_rgb (LLVM 17 or newer), cuda_ad_rgb (a GPU)."""
    denoise: bool = True
    """Whether Open Image Denoise smooths the picture."""

    def __post_init__(self) -> None:
        take_options(self)
        if self.light not in LIGHTS:
            raise unknown_name("light", self.light, LIGHTS)
        if self.variant not in ("", *VARIANTS):
            raise unknown_name("variant", self.variant, VARIANTS)


def shading_of(shader: str, options: Mapping[str, Any]) -> Shading | None:
    """The options of the path tracer, None for the rasterizer, which has none.

    Args:
        shader: one of `SHADERS`.
        options: by field of `Shading`.

    Raises:
        UsageError: unknown shader or option, a value out of its range, or options of the rasterizer.
    """
    if shader not in SHADERS:
        raise unknown_name("shader", shader, SHADERS)
    # Options that would do nothing are refused, as somebody expects something of them.
    if shader == RASTER:
        if options:
            raise UsageError(
                f"shading is for shader {PATH!r}; leave it out with {RASTER!r} (got {', '.join(options)})."
            )
        return None
    for name in options:
        if name not in Shading.__dataclass_fields__:
            raise unknown_name(
                "option of shading", name, tuple(Shading.__dataclass_fields__)
            )
    return Shading(**options)
