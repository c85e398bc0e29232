"""Storage of episodes on disk: schema, episode files, shards, checks, repair."""
