"""Layers under which scripts that were written for other projects run on mjhab."""
