"""Commands about this machine: installation, memory estimates, compiled kernels."""
