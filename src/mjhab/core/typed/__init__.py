"""Values of others, checked against the annotations of fields."""
