"""Relative motions that joints leave free: one class in one module each, behind one interface."""
