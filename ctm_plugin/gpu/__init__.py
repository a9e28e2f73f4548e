"""Triton kernels that make a GPU fast; :mod:`ctm_plugin.door` is where functions of other rooms meet them."""
