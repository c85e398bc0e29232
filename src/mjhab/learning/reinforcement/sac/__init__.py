"""Soft actor-critic, and with demonstrations (RLPD, arXiv 2302.02948)."""
