"""One module a figure, table or benchmark: `python -m experiments.NAME --out DIR --seed 0`."""
