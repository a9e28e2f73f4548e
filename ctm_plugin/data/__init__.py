"""Data sets: a file for each layout of photographs; ``readers`` opens files."""
