"""Storage of episodes on disk: schema, shards, journal, checks, repair."""
