"""Pages of runs, data sets and benches: numbers, plots, films in one HTML file."""
