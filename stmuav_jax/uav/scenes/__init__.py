"""Scenes of the report, each modelling only what it needs."""
