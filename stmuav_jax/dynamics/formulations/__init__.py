"""Equations of motion: the base class, maximal coordinates, stabilisation, reactions."""
