"""A viewer of runs in the browser."""
