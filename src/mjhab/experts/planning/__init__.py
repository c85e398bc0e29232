"""Planning of stances, base poses, approaches to objects and handles, and arm paths around obstacles."""
