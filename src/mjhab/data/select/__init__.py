"""What is made of recorded episodes: filters, sets, statistics, labels anew, torch windows."""
