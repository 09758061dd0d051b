"""Commands of the command line."""

import os

# Factorisations of NumPy, SciPy and JAX are OpenBLAS's, whose threads wait actively for each other over
# small matrices. It reads this when NumPy is imported, which no module has done yet: none but the command
# line imports this package.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
