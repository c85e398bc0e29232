"""The Interact benchmark: a fixed arm motion among objects, in many worlds at once."""
