"""Functions of small arrays as machine code, made from the same program that JAX traces."""
