"""Scripted whole-body experts that act only through the 13-D action."""
