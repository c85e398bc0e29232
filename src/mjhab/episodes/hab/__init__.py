"""Episodes in the format of Habitat's Home Assistant Benchmark."""
