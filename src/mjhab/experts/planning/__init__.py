"""Planning of base placements, base poses, approaches to objects and handles, and arm paths around obstacles."""
