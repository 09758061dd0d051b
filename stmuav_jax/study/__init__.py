"""Floor 4: what one asks of the machine: pointing, trim, linearisation, tuning, loads."""
