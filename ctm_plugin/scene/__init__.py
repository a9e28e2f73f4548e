"""A field's training data, whatever files they came from."""
