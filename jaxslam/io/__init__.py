"""Reading logs and writing results: one module a format; nothing else touches files."""
