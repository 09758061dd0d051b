"""Floor 5: many flights at once: distributions, studies, the batched engine, statistics."""
