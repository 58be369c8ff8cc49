"""Rössler: the spectrum of its observer, its control task, and why they were chosen.

Its equation is :class:`kkl_gym.systems.Rossler`.
"""

from training.spectrum import evenly_spaced
from training.systems.profile import Profile
from training.systems.task import ControlTask

PROFILE = Profile(
    eigenvalues=evenly_spaced(13, -0.4, -8.0),
    spinn_settings={"eigenvalues": evenly_spaced(9, -3.0, -20.0)},
    fault_deadline=2.0,
    task=ControlTask("rossler", period=0.1, duration=30.0),
    printed={"spinn": 4.77, "ae": 79.9, "dmf": 23.5, "node": 24.7},
)
