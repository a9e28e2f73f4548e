"""Settings: registries of names, checked dataclasses of plain values, and the command line's verbs."""
