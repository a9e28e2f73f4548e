"""Gaussian splats (Kerbl et al., SIGGRAPH 2023): projection, rasterisation, where they begin, how they grow."""
