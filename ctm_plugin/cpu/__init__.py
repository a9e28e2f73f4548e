"""Compiled loops in place of torch functions on a CPU; :mod:`ctm_plugin.door` decides which of the two runs."""
