"""Episodes: poses of objects, goals, and the state in which a world starts, with the robot's spawn."""
