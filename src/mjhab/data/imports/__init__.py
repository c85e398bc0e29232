"""Import of other projects' data as recorded episodes."""
