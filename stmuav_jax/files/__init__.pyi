"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .loop_file import (
    loop_to_dataset as loop_to_dataset,
    save_loop as save_loop,
)
from .model_file import (
    ParametricModel as ParametricModel,
    load_model as load_model,
    read_model as read_model,
)
from .model_text import (
    model_to_text as model_to_text,
    save_model as save_model,
)
from .mujoco_export import save_mjcf as save_mjcf
from .mujoco_import import (
    load_robot as load_robot,
    scene_from_mujoco as scene_from_mujoco,
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
from .urdf_export import save_urdf as save_urdf
