"""Dense rewards: the table of terms of a subtask, and the sum over worlds of mixed kinds."""
