"""Fields that train through a colour transform, and how they are scored and shown."""
