"""Floor 4: the report's scenes, each modelling only what it needs."""
