"""What other programs connect to, and with what: results, commands, keys."""
