"""Proximal policy optimization (Schulman et al., arXiv 1707.06347)."""
