"""A run: put together, trained, scored, read again."""
