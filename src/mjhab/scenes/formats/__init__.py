"""Readers of public file formats: glTF, URDF."""
