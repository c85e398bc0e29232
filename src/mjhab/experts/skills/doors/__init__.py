"""Hinged doors: opening, closing, and the motions for both."""
