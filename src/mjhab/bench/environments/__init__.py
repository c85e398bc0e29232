"""Measurements of environments: control steps by stage, on host and device."""
