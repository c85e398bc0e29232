"""Motions of the base: maps, lattices, routes, driving."""
