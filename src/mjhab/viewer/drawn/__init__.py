"""3-D models, poses, marks and camera images, shared by the served and the exported page."""
