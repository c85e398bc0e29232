"""Subtasks: one file and one `SubtaskSpec` each, and their registry."""
