"""What is done with recorded episodes: exports, replay, new labels."""
