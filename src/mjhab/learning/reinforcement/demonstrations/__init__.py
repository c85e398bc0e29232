"""Where demonstrations for reinforcement come from: the scripted expert, or recorded episodes."""
