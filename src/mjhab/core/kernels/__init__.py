"""Kernels compiled by numba, and how they are compiled; whoever imports them loads numba."""
