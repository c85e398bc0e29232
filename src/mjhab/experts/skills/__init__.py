"""One script per subtask, and what only one of them uses."""
