"""Where episodes come from: running worlds, which people can drive, and shards."""
