"""Triton kernels in place of torch functions on a GPU; :mod:`ctm_plugin.door` decides which of the two runs."""
