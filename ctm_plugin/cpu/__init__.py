"""Loops over voxels and samples that numba compiles for the CPU, each beside the torch version that GPUs run."""
