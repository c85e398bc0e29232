"""Worlds on MuJoCo Warp. Imported only for backend "warp", because Warp opens a CUDA context on every GPU."""
