"""Commands about asset data sets, homes, robots, environments, episode files and sets of starts."""
