"""What goes wrong around a run, what is promised then, and what is seen: `table.py` has the cases."""
