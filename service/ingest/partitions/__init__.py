"""Reprocessing of whole partitions, one task each, by local processes or on a Dask scheduler."""
