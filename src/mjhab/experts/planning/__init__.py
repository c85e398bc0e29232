"""Where to stand and how to reach: stances, approaches, ways around obstacles."""
