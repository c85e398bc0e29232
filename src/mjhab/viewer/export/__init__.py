"""Export of a recorded episode as one HTML file."""
