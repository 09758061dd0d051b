"""Floor 2: equations of motion, consistent starts, integration, reactions, certificates."""
