"""Commands that make, replay, select and export recorded episodes."""
