"""Opening and checking the files that layouts are made of."""
