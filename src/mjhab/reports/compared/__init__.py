"""Runs beside each other: episodes in pairs, training curves in one chart, the page about both."""
