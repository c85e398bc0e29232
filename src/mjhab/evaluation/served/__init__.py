"""Policies behind a websocket: those of others acting here, and ours acting elsewhere."""
