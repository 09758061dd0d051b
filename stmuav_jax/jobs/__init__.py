"""Floor 7: carries out studies, here or on a cluster, and keeps their results."""
