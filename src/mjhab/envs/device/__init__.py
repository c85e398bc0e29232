"""Environments of the warp backend, with torch tensors on its device; imported only when the backend is used."""
