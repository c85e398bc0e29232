"""Rendering of worlds: render scenes, textures, views and films."""
