"""What observations can tell in two ways: names of the conventions, and the conversions between them."""
