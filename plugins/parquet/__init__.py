"""Parquet: a sink for tables of results, and a source of pictures in a column."""
