"""From names and plain values to checked settings."""
