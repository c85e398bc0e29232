"""``mjhab bench``: parse, call a bench, print what it found."""
