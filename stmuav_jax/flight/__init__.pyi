"""Public names of this folder; `__init__.py` imports each when it is first used."""

from .endurance import (
    HoverEndurance as HoverEndurance,
    Outfit as Outfit,
    day_endurance as day_endurance,
    hover_demand as hover_demand,
    uav_mass as uav_mass,
    uav_outfits as uav_outfits,
)
from .equilibrium import (
    Trim as Trim,
    trim as trim,
)
from .flight_trim import (
    FlightTrim as FlightTrim,
    TrimLimits as TrimLimits,
    TrimReason as TrimReason,
    trim_flight as trim_flight,
)
from .flyer import (
    Flyer as Flyer,
    FlyerPoint as FlyerPoint,
    RotorsAndForces as RotorsAndForces,
    rotors_and_forces as rotors_and_forces,
)
from .identification import (
    IdentifiabilityError as IdentifiabilityError,
    Identified as Identified,
    Unknown as Unknown,
    check_identifiable as check_identifiable,
    from_table as from_table,
    identify as identify,
    identify_many as identify_many,
    motion_model as motion_model,
)
from .linear import (
    Linear as Linear,
    linearize as linearize,
)
from .mass_properties import (
    centre_of_mass as centre_of_mass,
    inertia_about_centre as inertia_about_centre,
    inner_momentum as inner_momentum,
)
from .multiple_shooting import (
    growth as growth,
    shooting as shooting,
    transition as transition,
)
from .panel_design import (
    BreakEven as BreakEven,
    PanelDesign as PanelDesign,
    break_even as break_even,
    panel_gain as panel_gain,
)
from .slopes import (
    trim_slopes as trim_slopes,
)
from .steady import (
    FlightCondition as FlightCondition,
    climb as climb,
    cruise as cruise,
    hover as hover,
    steady_turn as steady_turn,
    trim_condition as trim_condition,
)
from .synthetic import (
    experiment as experiment,
)
from .tuning import (
    InputTuning as InputTuning,
    Limit as Limit,
    TunedMotion as TunedMotion,
    departures as departures,
    end_at as end_at,
    joint_forces as joint_forces,
    roughness as roughness,
    tune_inputs as tune_inputs,
)
from .uav_tuning import (
    SlewLimits as SlewLimits,
    at_rest as at_rest,
    hold as hold,
    holding_time as holding_time,
    peaks as peaks,
    slew as slew,
)
