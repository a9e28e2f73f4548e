"""Colour spaces, learned transforms, light, and the loss between colours."""
