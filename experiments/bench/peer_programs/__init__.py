"""Programs that train with one library each, and their host."""
