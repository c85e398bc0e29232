"""Readers of glTF and URDF files."""
