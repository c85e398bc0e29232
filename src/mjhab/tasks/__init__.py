"""What a task means: plans, signals, success, progress, labels. Pure functions on numpy or torch arrays."""
