"""Three plants in physical units: minutes and seconds, kelvin and mol/l, volts and amperes.

Scales, sampling and noise have defaults that follow from the equations and the training box. Try::

    kkl-gym diagnose examples/physical_units.py:StirredTank
    kkl-gym train examples/physical_units.py:StirredTank
    kkl-gym evaluate runs/stirred_tank/stirred_tank.safetensors --system examples/physical_units.py:StirredTank --ekf
"""

from dataclasses import dataclass
from typing import ClassVar

from kkl_gym import System
from kkl_gym.elementary import exp, sqrt


@dataclass(frozen=True)
class StirredTank(System):
    """A cooled tank with an exothermic reaction of A to B; the temperature is measured. Time is in minutes.

    c' = q (c_feed - c) - k(T) c, T' = q (T_feed - T) + heat k(T) c + cooling (T_jacket + u - T) with k = k0 exp(-E/T),
    after the example in D. E. Seborg, T. F. Edgar and D. A. Mellichamp, Process Dynamics and Control.
    """

    q: float = 1.0  # 1/min
    c_feed: float = 1.0  # mol/l
    T_feed: float = 350.0  # K
    T_jacket: float = 300.0  # K
    k0: float = 7.2e10  # 1/min
    E: float = 8750.0  # K
    heat: float = 209.2  # K l/mol
    cooling: float = 2.092  # 1/min

    name: ClassVar[str] = "stirred_tank"
    state_names: ClassVar = ("concentration in mol/l", "temperature in K")
    X: ClassVar = ((0.1, 1.0), (310.0, 390.0))
    bounds: ClassVar = ((0.0, 2.0), (200.0, 600.0))
    u_max: ClassVar = (5.0,)  # K

    @property
    def target(self):
        """The middle one of three equilibria."""
        return (0.5, 350.0)

    def f(self, x):
        """Drift."""
        c, T = x
        reaction = self.k0 * exp(-self.E / T) * c
        warming = self.q * (self.T_feed - T) + self.heat * reaction + self.cooling * (self.T_jacket - T)
        return self.q * (self.c_feed - c) - reaction, warming

    def g(self, x):
        """Input gain."""
        return (0.0,), (self.cooling,)

    def h(self, x):
        """Output."""
        return (x[1],)


@dataclass(frozen=True)
class HeatedTank(System):
    """A heated tank with a flow of water (4.18e6 J/K per m^3); its temperature is measured, not the level. SI units.

    level' = (inflow - outlet sqrt(level)) / area, T' = (inflow (T_in - T) + (power + u) / 4.18e6) / (area level).
    """

    inflow: float = 0.02  # m^3/s
    outlet: float = 0.02 / 10.0**0.5  # m^2.5/s
    area: float = 0.5  # m^2
    T_in: float = 285.0  # K
    power: float = 2.9e6  # W

    name: ClassVar[str] = "heated_tank"
    state_names: ClassVar = ("level in m", "temperature in K")
    X: ClassVar = ((8.0, 12.0), (300.0, 340.0))
    bounds: ClassVar = ((4.0, 16.0), (280.0, 370.0))
    u_max: ClassVar = (5e5,)  # W

    @property
    def target(self):
        """The equilibrium."""
        return ((self.inflow / self.outlet) ** 2, self.T_in + self.power / 4.18e6 / self.inflow)

    def f(self, x):
        """Drift."""
        level, T = x
        heating = self.inflow * (self.T_in - T) + self.power / 4.18e6
        return (self.inflow - self.outlet * sqrt(level)) / self.area, heating / (self.area * level)

    def g(self, x):
        """Input matrix."""
        return (0.0,), (1 / (4.18e6 * self.area * x[0]),)

    def h(self, x):
        """Output."""
        return (x[1],)


@dataclass(frozen=True)
class Motor(System):
    """A direct-current motor with a fan; the current is measured, the speed is not. SI units."""

    resistance: float = 1.0  # ohm
    inductance: float = 2e-3  # H
    flux: float = 0.05  # V s/rad
    inertia: float = 1e-4  # kg m^2
    drag: float = 5e-6  # N m s^2/rad^2

    name: ClassVar[str] = "motor"
    state_names: ClassVar = ("current in A", "speed in rad/s")
    X: ClassVar = ((-10.0, 10.0), (-300.0, 300.0))
    bounds: ClassVar = ((-60.0, 60.0), (-1000.0, 1000.0))
    u_max: ClassVar = (24.0,)  # V

    def f(self, x):
        """Drift."""
        i, w = x
        torque = self.flux * i - self.drag * w * abs(w)
        return (-self.resistance * i - self.flux * w) / self.inductance, torque / self.inertia

    def g(self, x):
        """Input gain."""
        return (1 / self.inductance,), (0.0,)

    def h(self, x):
        """Output."""
        return (x[0],)
