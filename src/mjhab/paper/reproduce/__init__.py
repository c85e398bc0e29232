"""Reproduction of the MS-HAB paper's results: train policies, evaluate them, compare them with the paper's numbers."""
