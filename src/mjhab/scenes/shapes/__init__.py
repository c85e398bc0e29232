"""Geometry of what stands in a home: meshes, hulls, openings, footprints, painted textures."""
