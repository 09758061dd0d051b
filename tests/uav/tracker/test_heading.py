"""The heading of the most energy, which `stmuav sun` takes where none is given."""

import inspect
import math
from datetime import UTC, date
from types import SimpleNamespace

import pytest

from stmuav_jax.uav.environment.ephemeris import Place
from stmuav_jax.uav.tracker import day as day_module

PHNOM_PENH, EQUINOX = Place.degrees(11.55, 104.92), date(2024, 3, 21)


@pytest.mark.parametrize(("best", "found"), [(64, 60), (44, 45), (-170, -165), (-179, 180)])
def test_the_best_multiple_of_fifteen_degrees(best, found, monkeypatch):
    """Of an energy with one maximum, in ten days or fewer."""
    tried = []

    def day(place, day, zone, R_wb, **options):
        assert options["step"] > 0
        tried.append(R_wb)
        return SimpleNamespace(energy={"tracker": math.cos(R_wb - math.radians(best))})

    monkeypatch.setattr(day_module, "track_day", day)
    search = inspect.unwrap(day_module.best_heading)
    yaw = search(PHNOM_PENH, EQUINOX, UTC, lambda yaw: yaw)
    assert math.degrees(math.remainder(yaw - math.radians(found), 2 * math.pi)) == pytest.approx(
        0.0, abs=1e-9
    )
    assert len(tried) <= 10
