"""Rasterizer on the CPU: numba kernels, without OpenGL."""
