"""Finished runs, gathered into the paper's tables."""
