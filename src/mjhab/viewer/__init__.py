"""Worlds and recorded episodes in the browser."""
