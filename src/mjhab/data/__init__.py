"""Recorded episodes: file schema, recorder, crash-safe shards, filters, relabelling. h5py is imported here only."""
