"""Batched simulators (C MuJoCo and MuJoCo Warp) behind one protocol."""
