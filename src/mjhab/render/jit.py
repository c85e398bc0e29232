"""Decorators that compile the kernels of the rasterizer and of the textures."""

from __future__ import annotations

from functools import partial

from mjhab.core.kernels.jit import compiler

KERNEL_MODULES = (
    "core.kernels.counter",
    "render.jit",
    "render.lanes",
    "render.raster.arrays",
    "render.raster.meshes",
    "render.raster.sight",
    "render.raster.lighting",
    "render.raster.occlusion",
    "render.raster.batch",
    "render.raster.faces",
    "render.raster.fill",
    "render.raster.kernels",
    "render.raster.nodes",
    "render.raster.shading",
    "render.raster.surfaces",
    "render.raster.texturing",
    "render.patterns",
    "render.textures",
)
"""Modules whose code or constants are compiled into kernels; a change of any of them recompiles all."""
# ``_nrt`` off: the kernels allocate no arrays (see ``arrays.Scratch``), and reference counting costs time.
_compiler = partial(compiler, *KERNEL_MODULES, _nrt=False)
_NUMBERS = {"nnan", "nsz"}
"""Fast-math flags: inputs are not NaN and the sign of zero does not matter. min and max then compile to one (vector)
instruction, while sums and products stay exact."""
kernel = _compiler(fastmath=_NUMBERS)
inline = _compiler(forceinline=True, fastmath=_NUMBERS)
"""For helpers called per triangle or per pixel: a call that is not inlined copies the descriptors of its arrays."""
color_kernel = _compiler(fastmath=True)
"""For colours. Not for edges and depths, which must be identical for the two triangles at an edge."""
color_inline = _compiler(forceinline=True, fastmath=True)
