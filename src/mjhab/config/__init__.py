"""Options of environments (`EnvConfig`), and profiles: named values of many options at once."""
