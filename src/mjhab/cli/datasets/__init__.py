"""Commands that generate, replay, select and export recorded episodes."""
