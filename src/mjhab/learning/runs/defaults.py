"""Defaults of training runs that `mjhab --help` shows; this module imports nothing, so that help is fast."""

FILMED_EPISODES = 2
"""Episodes that are filmed in the first and in the last evaluation of a run."""
