"""Options of the commands for recorded episodes."""
