"""Policies by name, and their evaluation: where environment, policy, rollout loop and report come together."""
