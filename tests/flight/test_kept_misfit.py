"""Kept programs of a search: shared by records of one flight, and never by another model's."""

import json
import subprocess
import sys

# In a process of its own: functions whose arguments are checked, as those of the tests, are not kept.
PROGRAM = """
import json, sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import stmuav_jax as stm
from stmuav_jax.algebra import kept
from stmuav_jax.algebra.least_squares import value_and_columns
from stmuav_jax.flight.identification import Misfit, from_table, motion_model
from stmuav_jax.flight.synthetic import UNKNOWNS, outputs
from stmuav_jax.flight.uav_tuning import at_rest
from stmuav_jax.tracker.tracker_options import Friction

kept._PACKAGES = (*kept._PACKAGES, "__main__")
kept.keep_programs(sys.argv[1])
TIMES = np.linspace(0.0, 0.4, 5)

def rubbing(table):
    return stm.scenes.uav_flyer(table, friction=Friction())

def smooth(table):
    return stm.scenes.uav_flyer(table)

def name(make=rubbing, table=stm.PART_II, ts=TIMES, unknowns=UNKNOWNS, record=0.0, rtol=1e-9):
    method = stm.Method(rtol=rtol, atol=1e-9)
    made = from_table(make, table, unknowns)
    predict = motion_model(made, at_rest([0.0, 0.1]), ts, outputs, method=method)
    numbers = (jnp.full((len(ts), 11), record), jnp.ones(11), *jnp.ones((2, len(unknowns))))
    given = Misfit(predict, *numbers), jnp.zeros(len(unknowns))
    return kept.key_of(value_and_columns.__wrapped__, given, ())

lighter = stm.PART_II.replaced({"mass.slider_2": 0.1}, source="test")
swapped = (UNKNOWNS[1], UNKNOWNS[0], *UNKNOWNS[2:])
others = [
    name(make=smooth), name(table=lighter), name(ts=2 * TIMES), name(ts=TIMES[:-1]),
    name(unknowns=UNKNOWNS[1:]), name(unknowns=swapped), name(rtol=1e-8),
]
print(json.dumps([name(), name(record=0.5), others]))
"""


def test_records_of_a_flight_share_a_program_and_other_models_have_their_own(tmp_path):
    """Names of the kept programs for another make, table, times, unknowns and tolerance differ."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "programs")],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    first, of_another_record, others = json.loads(done.stdout)
    assert first is not None
    assert of_another_record == first
    assert None not in others
    assert len({first, *others}) == 1 + len(others)
