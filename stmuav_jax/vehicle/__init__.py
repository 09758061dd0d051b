"""Floor 3: the report's machine: parameters with units and sources, rotors, tracker, sun."""
