"""The networks that learn: one file per algorithm, and what they share."""
