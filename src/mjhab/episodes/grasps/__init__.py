"""How a parallel gripper takes an object, and how it holds one at the start of an episode."""
