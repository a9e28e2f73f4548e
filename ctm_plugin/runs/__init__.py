"""Runs: assembled from a configuration, trained, scored, read again from their folders."""
