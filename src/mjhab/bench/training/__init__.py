"""Measurements of learners: updates, learning curves, windows of recorded data."""
