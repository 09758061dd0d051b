"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .model_file import (
    load_model as load_model,
    model_to_text as model_to_text,
    save_model as save_model,
)
from .netcdf import (
    FileError as FileError,
    load as load,
    load_parameters as load_parameters,
    save as save,
    save_certificate as save_certificate,
    to_dataset as to_dataset,
)
from .store import (
    Store as Store,
    open_store as open_store,
)
from .study_file import (
    column as column,
    load_study as load_study,
)
