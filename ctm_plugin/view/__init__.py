"""A viewer of runs in the browser; see :mod:`ctm_plugin.view.__main__`."""
