"""What makes a CPU fast; :mod:`ctm_plugin.door` is where functions of other rooms meet their loops."""
