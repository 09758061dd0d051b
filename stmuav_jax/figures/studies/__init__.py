"""Figures, tables and report of a study of many samples. A part of floor 14."""
