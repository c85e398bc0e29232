"""LeRobot data sets, versions 3.0 and 2.1."""
