"""Commands that train, evaluate, score and serve policies."""
