"""Observations: a table of rows with key, shape, unit, frame and function, for the state and for the cameras."""
