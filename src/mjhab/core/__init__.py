"""What all packages share and no simulator needs; it imports no other package of mjhab.

Values: array functions for numpy and torch, rotations, boxes, grids, columns of joints, action notes, times of a
control step. Names and errors: paths of names, seeded random streams, error types, version. Machine: cores and memory,
caches in memory, progress bars. Folders: ``files/`` (cache on disk, code digests, locks), ``registration/`` (registries
and plugins), ``kernels/`` (numba-compiled functions).
"""
