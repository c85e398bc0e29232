"""Commands about what there is: data sets of homes, homes, robots, environments, episodes, starts."""
