"""Measurements of worlds that move: engine, grasps, sleeping islands."""
