"""Policies that were trained in the original MS-HAB, run here as they were run there."""
