"""Array-namespace helpers, rotations, seeded streams, errors. Imports nothing of ours."""
