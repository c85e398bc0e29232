"""HTML reports of runs, data sets and benchmarks: tables, plots and films in one file each."""
