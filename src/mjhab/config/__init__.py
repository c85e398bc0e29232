"""What an environment is told: its options, and profiles that set many of them at once."""
