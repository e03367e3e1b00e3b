"""Parquet: a sink for tables of results."""
