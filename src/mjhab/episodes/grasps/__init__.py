"""Grasps of a parallel gripper: candidates on objects, and stable grasps for starts with a held object."""
