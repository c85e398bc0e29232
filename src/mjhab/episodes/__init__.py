"""Where worlds start: arrangements of objects, and where the robot begins."""
