"""Training budgets and test protocols, which ``--budget`` and ``--quick`` select.

Durations and dt are for a System.pace of 1 s. They grow in proportion to it, so the number of steps stays the same.
"""

import math
from dataclasses import replace

from examples.research.benchmark.protocol import Protocol
from examples.research.methods import Budget
from kkl_gym.system import System

BUDGETS = {
    "cpu": Budget("cpu", trajectories=2000, duration=50.0, samples=200, cpu_seconds=300.0),
    # The quick trainings end after a number of batches, not of seconds, so that results do not depend on the machine.
    "quick": Budget(
        "quick", trajectories=200, duration=20.0, samples=50, cpu_seconds=math.inf, width=64, depth=2, steps=300
    ),
    "short": Budget("short", trajectories=1000, duration=50.0, samples=200, cpu_seconds=40.0),
}

PROTOCOL = Protocol()
QUICK_PROTOCOL = Protocol(trajectories=5, duration=10.0)
VALIDATION = Protocol(trajectories=20, duration=20.0)
SEARCH = 0.2  # share of the budget's CPU seconds for the training of each compared configuration


def paced_budget(budget: Budget, system: System) -> Budget:
    """Return the budget with its duration and dt scaled by a system's pace."""
    dt = float(f"{budget.dt * system.pace:.12g}")  # removes the rounding error of the product
    return replace(budget, duration=budget.duration * system.pace, dt=dt)


def paced_protocol(protocol: Protocol, system: System) -> Protocol:
    """Return the protocol with its duration scaled by a system's pace."""
    return replace(protocol, duration=protocol.duration * system.pace)
