"""A Panda arm on an Omron LD-60 base, as robosuite and RoboCasa have it."""
