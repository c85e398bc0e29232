"""Environments whose arrays are torch tensors on the device of the warp backend; imported only when it is asked for."""
