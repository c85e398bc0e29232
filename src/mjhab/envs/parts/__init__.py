"""Parts of an environment; each does one task in a control step: sensing, rewards, labels, observations, reports."""
