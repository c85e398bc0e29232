"""The Home Assistant Benchmark on MuJoCo."""
