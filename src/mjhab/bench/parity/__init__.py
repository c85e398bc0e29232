"""Differences between the two simulators over whole episodes."""
