# type: ignore
"""Materials, textures and lamps of a render scene on a device."""

from __future__ import annotations

import warp as wp


@wp.struct
class SceneArrays:
    """Arrays of ``RenderScene``: of faces (F), instances (I), materials (M) without ``mat_``, lamps (L) of homes (H).

    extent (I,): size of each instance's mesh along its axes [m], without the instance's scale. pixels, start, bits: see
    ``textures.Texels``. tone: see ``raster.shading.tone_curve``. disk (TURNS, TAPS): sample offsets of the ambient
    occlusion.
    """

    face_material: wp.array[int]
    face_normal: wp.array2d[wp.vec4]
    face_uv: wp.array2d[wp.vec4]
    face_density: wp.array[float]
    extent: wp.array[wp.vec3]
    instance_material: wp.array2d[int]
    color: wp.array[wp.vec3]
    color2: wp.array[wp.vec3]
    texture: wp.array[int]
    pattern: wp.array[int]
    size: wp.array[wp.vec2]
    gloss: wp.array[float]
    pixels: wp.array[wp.uint32]
    start: wp.array2d[int]
    bits: wp.array2d[int]
    tone: wp.array[wp.uint8]
    disk: wp.array2d[wp.vec2]
    lamp_pos: wp.array2d[wp.vec3]
    lamp_color: wp.array2d[wp.vec3]
