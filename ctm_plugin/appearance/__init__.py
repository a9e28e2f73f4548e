"""Appearances: what makes photographs of one field differ, such as exposure and white balance."""
