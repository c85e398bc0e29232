"""Geometry of furniture and objects: meshes, simplification, convex hulls, footprints, opening ranges, textures."""
