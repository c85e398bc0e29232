"""Motion planning and driving of the base: maps of free floor, lattices, routes, following."""
