"""What a learned policy sees: parts, their names and widths, and the one encoder of them."""
