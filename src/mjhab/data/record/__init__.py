"""Recording of episodes: the recorder, generation with several workers, and replay."""
