"""Public data sets on this machine: where they come from, download, checks, atomic installation."""
