"""Loggers: where curves, pictures and scores go."""
