"""Verbs that do several others in a row: photographs to a page, and the demo."""
