"""Commands about this machine: what is installed, what fits into memory, compiled kernels."""
