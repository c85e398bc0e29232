"""Registries of named things and the plugins that fill them."""
