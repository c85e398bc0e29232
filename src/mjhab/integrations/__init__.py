"""Bridges to other people's packages, each of which is imported where it is used."""
