"""Running episodes and what is made of them: policies, THE rollout loop, sinks, metrics, the report."""
