"""Integration in time of any formulation, on top of diffrax."""
