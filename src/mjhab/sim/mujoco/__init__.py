"""Worlds on C MuJoCo."""
