"""Use of recorded episodes: filters, merging and splitting, statistics, relabelling, torch windows."""
