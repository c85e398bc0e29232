"""Worlds on MuJoCo Warp. Imported only when the backend is asked for: Warp opens a context on every GPU."""
