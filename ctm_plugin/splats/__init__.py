"""Gaussian splats (Kerbl et al., SIGGRAPH 2023): projection, rasterisation, initialisation, density control."""
