"""The render scene: meshes and instances shared by all worlds of a layout, outside the MjModel.

An instance hangs on a body of the model (robot links, drawers, doors, objects) or stands in the world
(furniture, walls; its pose depends on the home).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.render.textures import Texels


@dataclass(frozen=True, eq=False)
class RenderScene:
    """Arrays for the rasterizer. I instances, N meshes, V vertices, F faces, M materials, H homes.

    vertices (V, 3) f32 in instance frame [m]; faces (F, 3) i32, indices into ``vertices``; face_material (F,) i32;
    face_normal (F, 3, 4) f32, face_uv (F, 2, 4) f32: affine maps from the point in the instance frame to its normal and
    to its place in the texture (see ``mesh_levels.Level``); face_density (F,) f32: texture per length [1/m];
    mesh_face_start, mesh_face_count (N,) i32; mesh_coarser (N,) i32: mesh that stands for this one from afar or -1;
    mesh_error (N,) f64: how far a mesh is off from the finest one [m];
    instance_mesh (I,) i32: finest mesh; instance_body (I,) i32 (0: the world);
    instance_pos (I, 3), instance_mat (I, 3, 3): pose in the body's frame, or for world instances: ignored;
    home_pos (H, I, 3), home_mat (H, I, 3, 3): world pose of world instances per home; home_scale (H, I, 3): scale
    of the mesh along the axes of the instance, for body instances too (unit boxes become walls; zeros hide);
    instance_seg (I,) i32: id in segmentation images (0 is background); seg_names: its names, index = id.
    instance_material (H, I) i32 or -1: overrides face_material (walls and floors of homes).
    mat_* (M, ...): base colours (linear rgb), second colour, texture or -1, whether it is a pattern of the two colours
    (else a picture), size of a pattern (u, v) [m], gloss.
    light_pos (H, L, 3), light_color (H, L, 3) (zero colour: unused slot).
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_material: np.ndarray
    face_normal: np.ndarray
    face_uv: np.ndarray
    face_density: np.ndarray
    mesh_face_start: np.ndarray
    mesh_face_count: np.ndarray
    mesh_coarser: np.ndarray
    mesh_error: np.ndarray
    instance_mesh: np.ndarray
    instance_body: np.ndarray
    instance_pos: np.ndarray
    instance_mat: np.ndarray
    instance_seg: np.ndarray
    instance_material: np.ndarray
    home_pos: np.ndarray
    home_mat: np.ndarray
    home_scale: np.ndarray
    mat_color: np.ndarray
    mat_color2: np.ndarray
    mat_texture: np.ndarray
    mat_pattern: np.ndarray
    mat_size: np.ndarray
    mat_gloss: np.ndarray
    light_pos: np.ndarray
    light_color: np.ndarray
    texels: Texels
    seg_names: tuple[str, ...]
