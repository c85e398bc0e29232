"""Benchmarks for developers of mjhab, run from a checkout: ``python -m benchmarks.NAME``; no part of the package."""
