"""A score that counts: fixed episodes, a result file that can be checked, and a table made of such files."""
