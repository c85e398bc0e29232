"""Which of several policies does what: the entries of a file or of a folder of policies."""
