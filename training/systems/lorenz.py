"""Lorenz: the spectrum of its observer, its control task, and why they were chosen.

Its equation is :class:`kkl_gym.systems.Lorenz`.
"""

from training.spectrum import evenly_spaced
from training.systems.profile import Profile
from training.systems.task import control_task

PROFILE = Profile(
    eigenvalues=evenly_spaced(13, -1.5, -25.0),  # faster than the others', as its flow is
    spinn_settings={"eigenvalues": evenly_spaced(9, -9.0, -40.0)},
    settings={"measurement_noise_max": 3.0},  # its output is the largest of the four
    fault_deadline=2.0,
    task=control_task("lorenz", duration=5.0),  # the input is weak
    second_noise=2.0,
    printed={"spinn": 8.64, "ae": 88.1, "dmf": 8.76, "node": 11.0},
)
