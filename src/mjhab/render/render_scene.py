"""The render scene: meshes and instances shared by all worlds of a layout, outside the MjModel.

An instance is attached to a body of the model (robot links, drawers, doors, objects), or to the world (furniture,
walls), where its pose depends on the home.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.render.textures import Texels


@dataclass(frozen=True, eq=False)
class RenderScene:
    """Arrays for the renderers. H homes, I instances, N meshes (one per level of detail), V vertices, F faces, M
    materials, L lamps.

    Attributes:
        vertices: (V, 3) f32 [m] in the frame of their mesh.
        faces: (F, 3) i32, indices into ``vertices``; the faces of a mesh are contiguous.
        face_material: (F,) i32 material ids.
        face_normal, face_uv: (F, 3, 4), (F, 2, 4) f32, affine maps from a point in the frame of the mesh to its normal
            and its texture coordinates, see `mesh_levels.Level`.
        face_density: (F,) f32, length in texture coordinates per length on the face [1/m].
        mesh_face_start, mesh_face_count: (N,) i32.
        mesh_coarser: (N,) i32, the next coarser level of detail, -1 for none.
        mesh_error: (N,) f64, bound of the distance to the finest level [m].
        instance_mesh: (I,) i32, finest level of the instance's mesh.
        instance_body: (I,) i32, body id in the MjModel; 0 is the world.
        instance_pos, instance_mat: (I, 3) [m], (I, 3, 3), pose in the body's frame; not used for world instances.
        instance_seg: (I,) i32, id in segmentation images; 0 is background.
        instance_material: (H, I) i32, replaces ``face_material``; -1 keeps it.
        home_pos, home_mat: (H, I, 3) [m], (H, I, 3, 3), world pose of world instances per home.
        home_scale: (H, I, 3), scale of the mesh along the axes of every instance; 0 hides the instance.
        mat_color, mat_color2: (M, 3) linear rgb; the second colour is used by patterns.
        mat_texture: (M,) i32, index into ``texels``, -1 for none.
        mat_pattern: (M,) bool, whether the texture is a pattern (see `patterns`) rather than an image.
        mat_size: (M, 2), size (u, v) of one period of a pattern [m].
        mat_gloss: (M,), 0 to 1.
        mat_kind: (M,) str, `scenes.builtin.materials.Material.kind`.
        light_pos, light_color: (H, L, 3) [m], (H, L, 3) linear rgb times intensity; 0 marks an unused slot.
        texels: the textures.
        seg_names: names of the segments, by id.
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
    mat_kind: np.ndarray
    light_pos: np.ndarray
    light_color: np.ndarray
    texels: Texels
    seg_names: tuple[str, ...]
