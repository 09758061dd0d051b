"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .cluster import (
    run_on_cluster as run_on_cluster,
)
from .local import (
    run_study as run_study,
)
