"""Robot and homes as one layout, and one MjModel per home."""
