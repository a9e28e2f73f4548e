"""What a run gives to others: films, a page, and files for other programs."""
