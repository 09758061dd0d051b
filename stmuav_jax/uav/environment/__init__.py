"""Sun, irradiance and wind."""
