"""The built-in asset pack: homes, furniture and objects made by code."""
