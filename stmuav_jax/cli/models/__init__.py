"""Commands on any mechanism: a scene by name, or a file with a model."""
