"""Scores of rendered images and depth. Start at :func:`ctm_plugin.metrics.evaluate.summarize`."""
