"""How each photograph shows the one field: its exposure, its white balance, what its camera did from place to place."""
