"""A training run of imitation: its specification, its session, what it collects, evaluates and reports."""
