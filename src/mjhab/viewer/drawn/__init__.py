"""What is drawn of a home and a robot, wherever its page is."""
