"""Sources of the viewer's episodes: running worlds, which a person can teleoperate, and shards of recorded episodes."""
