"""Pictures out of tensors."""
