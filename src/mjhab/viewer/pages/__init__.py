"""The page that is served: its panels, its time line, and the port."""
