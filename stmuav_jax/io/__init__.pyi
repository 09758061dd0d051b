"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .flight_log import (
    Channel as Channel,
    FlightLog as FlightLog,
    Gap as Gap,
    read_flight_log as read_flight_log,
    read_rotor_layout as read_rotor_layout,
    save_flight_record as save_flight_record,
)
from .identified_model import (
    IdentifiedFiles as IdentifiedFiles,
    write_identified_model as write_identified_model,
)
from .log_formats import (
    LogSetting as LogSetting,
)
from .model_file import (
    ParametricModel as ParametricModel,
    load_model as load_model,
    model_to_text as model_to_text,
    read_model as read_model,
    save_model as save_model,
)
from .mujoco_export import (
    save_mjcf as save_mjcf,
)
from .mujoco_import import (
    load_robot as load_robot,
    scene_from_mujoco as scene_from_mujoco,
)
from .netcdf import (
    FileError as FileError,
    load as load,
    load_parameters as load_parameters,
)
from .run_file import (
    loop_to_dataset as loop_to_dataset,
    save as save,
    save_certificate as save_certificate,
    save_loop as save_loop,
    to_dataset as to_dataset,
)
