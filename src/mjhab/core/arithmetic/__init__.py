"""Arithmetic that gives the same bits everywhere, and what tells machines apart where it does not."""
