"""Options of the commands, as dataclasses for tyro."""
