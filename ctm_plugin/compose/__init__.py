"""Configurations: composed out of choices and keys by Hydra, checked, and what is ``auto`` in them decided."""
