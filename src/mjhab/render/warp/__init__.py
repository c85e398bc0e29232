"""Robot cameras on the GPU: ray casting kernels in Warp."""
