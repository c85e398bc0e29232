"""The Fetch mobile manipulator."""
