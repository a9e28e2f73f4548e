"""What a training step costs, part by part, on this machine."""
