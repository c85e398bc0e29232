"""Options of the commands that train, score and serve policies."""
