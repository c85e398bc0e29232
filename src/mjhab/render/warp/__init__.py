"""Cameras on the device: ray kernels on Warp."""
