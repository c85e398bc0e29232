"""Recorded episodes in the layouts of others."""
