"""How episodes lie on the disk: schema, shards, journal, checks, repair."""
