"""Policies by name, their evaluation, and the generation of data sets with them."""
