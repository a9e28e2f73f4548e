"""Colours and appearances to compare the recommended ones with: no page recommends them, and no paper needs them."""
