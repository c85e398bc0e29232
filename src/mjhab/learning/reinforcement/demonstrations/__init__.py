"""Sources of demonstrations for reinforcement learning: the scripted expert and recorded episodes."""
