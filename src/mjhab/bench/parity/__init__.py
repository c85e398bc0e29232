"""How far apart the backends are over whole episodes."""
