"""Long runs that tell what breaks and what grows."""
