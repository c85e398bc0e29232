"""Data of others as recorded episodes."""
