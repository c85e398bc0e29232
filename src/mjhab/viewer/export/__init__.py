"""An episode as one file."""
