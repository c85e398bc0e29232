"""Differences between the two simulators over whole episodes: ``python -m benchmarks.parity``."""
