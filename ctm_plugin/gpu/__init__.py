"""What makes a GPU fast: Triton kernels; :mod:`ctm_plugin.door` is where functions of other rooms meet them."""
