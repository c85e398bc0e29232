"""How worlds look: drawn scenes, textures, views, films."""
