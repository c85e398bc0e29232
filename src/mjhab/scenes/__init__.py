"""Asset packs, homes, furniture, objects, the Fetch robot, and their compilation to MuJoCo models."""
