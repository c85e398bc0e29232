"""The served page of the viewer: panels, time line, and the web server."""
