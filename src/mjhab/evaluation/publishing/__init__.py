"""Data sets worth publishing: made by one command, described, checked, pushed and pulled."""
