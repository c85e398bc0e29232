"""What an environment is put together from: each part does one thing in a control step."""
