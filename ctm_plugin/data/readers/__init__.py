"""Opening and checking files. Whatever is wrong with one is a :class:`~ctm_plugin.errors.DataError` that names it."""
