"""The budgets of trainings and the test protocols behind ``--budget`` and ``--quick``.

Times are at the pace of the shipped systems; other systems are given as many samples of their own.
"""

import math
from dataclasses import replace

from examples.research.benchmark.protocol import Protocol
from examples.research.methods import Budget
from kkl_gym.system import System

BUDGETS = {
    "cpu": Budget("cpu", trajectories=2000, duration=50.0, samples=200, cpu_seconds=300.0),
    # As many batches on any machine, so that the same results come out again.
    "quick": Budget(
        "quick", trajectories=200, duration=20.0, samples=50, cpu_seconds=math.inf, width=64, depth=2, steps=300
    ),
    "short": Budget("short", trajectories=1000, duration=50.0, samples=200, cpu_seconds=40.0),
}

PROTOCOL = Protocol()
QUICK_PROTOCOL = Protocol(trajectories=5, duration=10.0)
VALIDATION = Protocol(trajectories=20, duration=20.0)
SEARCH = 0.2  # of the budget's CPU seconds, for each configuration that is compared


def paced_budget(budget: Budget, system: System) -> Budget:
    """The same at a system's own pace."""
    dt = float(f"{budget.dt * system.pace:.12g}")  # the system's own, where rounding would not have it so
    return replace(budget, duration=budget.duration * system.pace, dt=dt)


def paced_protocol(protocol: Protocol, system: System) -> Protocol:
    """The same at a system's own pace."""
    return replace(protocol, duration=protocol.duration * system.pace)
