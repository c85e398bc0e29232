"""Benchmark scores: fixed episodes, a result file that can be verified, and a leaderboard of such files."""
