"""Reading logs and writing results: one module per format; no other module accesses files."""
