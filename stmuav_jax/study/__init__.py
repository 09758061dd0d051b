"""Floor 4: what one asks of the machine: a day of pointing at the sun."""
