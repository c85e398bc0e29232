"""Reinforcement learning: PPO, SAC, and SAC with demonstrations (RLPD), on both backends."""
