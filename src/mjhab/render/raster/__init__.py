"""The rasterizer on the CPU: numba kernels, no OpenGL."""
