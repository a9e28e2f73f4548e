"""Callbacks of a training: checkpoints, the dashboard, what ends it, the transform's optimizer."""
