"""What a field is trained on, whatever files it came from."""
