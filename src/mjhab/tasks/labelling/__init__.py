"""What is said of a subtask that ran: its events, its label, its label by the published rules."""
