"""Scripts of the subtasks, and modules that only one script uses."""
