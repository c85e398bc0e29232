"""Motion planning and control of the base: maps of free floor, lattice search, routes, path following."""
