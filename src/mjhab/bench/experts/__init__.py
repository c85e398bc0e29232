"""How often the scripted experts succeed, row by row, next to the paper's policies."""
