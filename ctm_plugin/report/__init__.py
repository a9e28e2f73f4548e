"""Finished runs, gathered into the paper's tables and figures: ``python -m ctm_plugin.report``."""
