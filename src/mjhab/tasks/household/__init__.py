"""Household tasks: one file and one `TaskSpec` each, and their registry."""
