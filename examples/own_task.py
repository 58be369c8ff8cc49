"""Your own task, from plant to agent: a motor brings an unmeasured link to a goal angle through a spring.

These commands train the observer, and an agent that acts on its estimate (docs/guides/own_task.md has more)::

    kkl-gym train examples/own_task.py
    kkl-gym agent train examples/own_task.py --observer runs/flexible_joint/flexible_joint.safetensors
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import tyro
from rich.console import Console

import kkl_gym
from kkl_gym.elementary import sin
from training import preset, train
from training.agents.learning import learn
from training.agents.play import play
from training.agents.seeds import agent_evaluation_seed
from training.agents.tasks import get_task


@dataclass(frozen=True)
class FlexibleJoint(kkl_gym.System):
    """A motor turns a link through a spring, under gravity; only the motor's angle is measured. SI units."""

    stiffness: float = 10.0  # N m/rad
    gravity: float = 2.0  # N m, torque of gravity on the link when it is level
    damping: float = 0.2  # N m s/rad, of motor and link
    goal: float = 0.6  # rad

    name: ClassVar[str] = "flexible_joint"
    state_names: ClassVar = ("motor in rad", "motor in rad/s", "link in rad", "link in rad/s")
    X: ClassVar = ((-1.0, 1.0), (-3.0, 3.0), (-1.0, 1.0), (-3.0, 3.0))
    bounds: ClassVar = ((-9.0, 9.0), (-40.0, 40.0), (-9.0, 9.0), (-40.0, 40.0))
    u_max: ClassVar = (4.0,)  # N m
    G: ClassVar = ((0.0,), (2.0,), (0.0,), (0.0,))

    def f(self, x):
        """Drift."""
        motor, motor_rate, link, link_rate = x
        torque = self.stiffness * (link - motor)
        pushed = 2.0 * (torque - self.damping * motor_rate)
        return motor_rate, pushed, link_rate, -torque - self.gravity * sin(link) - self.damping * link_rate

    def h(self, x):
        """Output."""
        return (x[0],)

    def reward(self, x, u):
        """1 if the link rests at its goal, and less otherwise."""
        return 1.0 / (1.0 + 20.0 * (x[2] - self.goal) ** 2 + 0.5 * x[3] ** 2)

    def terminated(self, x):
        """Whether the link hits a stop."""
        return abs(x[2]) > 2.0


def main(
    timesteps: int = 400_000, inverse_steps: int = 1500, trajectories: int = 500, out: Path = Path("runs/own_task")
) -> dict[str, float]:
    """Train an observer, an agent on its estimate and an agent on the measurement; returns the agents' mean returns.

    Args:
        timesteps: actions in the training of each agent.
        inverse_steps: batches of the observer's training.
        trajectories: simulated trajectories of the observer's training.
        out: the run's folder.
    """
    system, path = FlexibleJoint(), out / "flexible_joint.safetensors"
    config = preset(system, changes={"inverse_steps": inverse_steps, "trajectories": trajectories})
    train(system, config, out, resume=True, console=Console()).artifact.save(path)
    task, returns = get_task(__file__), {}
    for information, observer in (("x_hat", str(path)), ("y", None)):
        agent = learn(task, information, out / information, timesteps=timesteps, observer=observer)
        envs = agent.make(100, trusted=task.system)
        played = play(envs, agent.policy(envs.single_action_space), seed=agent_evaluation_seed(0, 100))
        returns[information] = float(played.returns.mean())
        print(f"an agent that sees {information}: a return of {returns[information]:.0f} of at most 2000")
    return returns


if __name__ == "__main__":
    tyro.cli(main)
