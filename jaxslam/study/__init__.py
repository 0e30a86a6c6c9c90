"""Studies: variants of a robot, its building and its filter, compared over many trials."""
