"""A page for any run: curves over time, the largest contacts, what was skipped, where time went."""
