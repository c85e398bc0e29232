"""``mjhab bench``: parse options, run a benchmark, print its results."""
