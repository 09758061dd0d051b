"""Identification of a multirotor from the record of a flight."""
