"""Asset packs, homes, furniture and objects, without a simulator."""
