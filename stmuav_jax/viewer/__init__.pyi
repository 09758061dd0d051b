"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .filming import (
    film as film,
)
from .page import (
    RunPage as RunPage,
    view as view,
)
from .shapes import (
    Shape as Shape,
)
from .sketch import (
    draw as draw,
)
