"""Measurements of environments: control steps by stage, on host and device, and what the dense reward costs."""
