"""Equations of motion in the relative coordinates of a spanning tree."""
