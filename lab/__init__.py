"""How accuracy and speed are judged: labels, judges, benchmarks, other packages. Never installed."""
