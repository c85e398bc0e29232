"""How the kernels of the rasterizer are compiled."""

from __future__ import annotations

from functools import partial

from mjhab.core.kernels.jit import compiler

KERNEL_MODULES = (
    "render.raster.jit",
    "render.raster.arrays",
    "render.raster.boxes",
    "render.raster.meshes",
    "render.raster.sight",
    "render.raster.lighting",
    "render.raster.occlusion",
    "render.raster.batch",
    "render.raster.fill",
    "render.raster.kernels",
    "render.raster.shading",
    "render.raster.surfaces",
    "render.raster.texturing",
    "render.patterns",
    "render.textures",
)
"""Modules whose code or constants go into kernels."""
# ``_nrt`` off: the kernels make no arrays (see ``kernels.Scratch``), and counting references costs time.
_compiler = partial(compiler, *KERNEL_MODULES, _nrt=False)
_NUMBERS = {"nnan", "nsz"}
"""No nan comes in, and zeros have no sign: smallest and largest of numbers take one instruction each, several at a
time; sums and products come out as ever."""
kernel = _compiler(fastmath=_NUMBERS)
inline = _compiler(forceinline=True, fastmath=_NUMBERS)
"""For helpers called per triangle or per pixel: a call would copy every array descriptor it is given."""
color_kernel = _compiler(fastmath=True)
"""For colours. Not for edges and depths, which must come out alike for the two triangles at an edge."""
color_inline = _compiler(forceinline=True, fastmath=True)
