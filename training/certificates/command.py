"""``kkl-gym certify``: a certificate as table, JSON and figure."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from observers import Artifact
from observers.artifact import resolve
from training.certificates.certify import (
    CERTIFICATE_SEED,
    Certificate,
    certify,
    noise_variance,
    record_motion,
    residual,
)
from training.files import write


@dataclass(frozen=True)
class Certify:
    """Say how far an observer is to be trusted: learned maps, sensitivities, noise, and the paper's bounds.

    Prints a table and writes certificate.json and certificate.png. docs/certificates.md explains each line.
    """

    observer: tyro.conf.Positional[str]
    """A shipped map, or a .safetensors file."""
    system: str | None = None
    """For files of your own system: its class, as script.py:Class or module:Class."""
    measurement_noise: float = 0.5
    """Standard deviation of the noise on each sample of y; for the theorems it is cut at three of these."""
    process_noise: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's)")] = None
    """Bound of the process noise as a multiple of the states' scales."""
    psi: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the motion's diameter)")] = None
    """Bound of how far process noise moves the state from where it would have been."""
    trajectories: int = 200
    """Number of motions, from starts uniform in X."""
    delta: float = 0.05
    """Probability with which each generalisation term may fail."""
    seed: int = 0
    """Of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="(default: certificates/NAME)")] = None
    """Folder for what is written."""

    def run(self, console: Console) -> Certificate:
        """Certify."""
        from training.cli import system_of

        artifact = Artifact.read(resolve(self.observer))
        system = system_of(artifact, self.system)
        name = Path(self.observer).stem if self.observer.endswith(".safetensors") else self.observer
        with console.status(f"certifying {name}"):
            found = certify(
                artifact,
                system,
                self.measurement_noise,
                self.process_noise,
                self.psi,
                self.trajectories,
                self.delta,
                self.seed,
                name,
            )
            folder = self.out or Path("certificates") / name
            folder.mkdir(parents=True, exist_ok=True)
            write(folder / "certificate.json", json.dumps(found.as_json(), indent=1, allow_nan=False) + "\n")
            draw(folder / "certificate.png", artifact, system, self.measurement_noise, name)
        console.print(table(found))
        console.print(f"wrote certificate.json and certificate.png in {folder}")
        return found


def table(found: Certificate) -> Table:
    """A certificate for people."""
    out = Table(title=f"{found.observer}: measurement noise {found.measurement_noise:g}", show_header=False)
    out.add_column("what")
    out.add_column("value", justify="right")

    def line(what: str, value: float, text: str = "") -> None:
        shown = "–" if not np.isfinite(value) else f"{value:.3g}"
        out.add_row(what, shown + text)

    line("rms error in the long run, no noise", found.error**0.5)
    line(f"the same, |v| <= {found.noise_bound:g}, |w| <= {found.process_noise:.3g}", found.noisy_error**0.5)
    line("error due to measurement noise alone, predicted", found.predicted_noise_error)
    line("the same, measured", found.measured_noise_error)
    out.add_section()
    line("Lipschitz constant of T_inv, at least", found.lipschitz_lower)
    line("the same, at most", found.lipschitz_upper)
    line("largest |dh/dx| over X", found.output_lipschitz)
    line("gain from v to z: the theorem's", found.gain_theorem)
    line("H-infinity (energy to energy)", found.gain_h_infinity)
    line("H2 (rms of z, white noise)", found.gain_h2)
    out.add_section()
    forward = found.forward
    if forward is None:
        out.add_row("no forward map T was learned:", "no residual,")
        out.add_row("", "no bound without noise")
        line("what the noisy theorem adds, as rms", found.noise_term**0.5)
    else:
        line("risk of T on its data, mean |z - T(x)|²", forward.data_risk)
        line("PDE residual, mean |P|² over X", forward.pde_risk)
        for level, value in forward.residual.items():
            line(f"|P|, {100 * level:g} % of X below", value)
        out.add_row("|P| largest at x =", ", ".join(f"{value:.2f}" for value in forward.residual_worst))
        line("reconstruction, mean |x - T_inv(T(x))|²", forward.reconstruction_risk)
        line("the same over X", forward.reconstruction_risk_over_box)
        out.add_section()
        line("bound of the rms error, no noise", forward.bound**0.5)
        line("bound / measured", (forward.bound / found.error) ** 0.5)
        line("bound of the rms error, noise", forward.noisy_bound**0.5)
        line("bound / measured", (forward.noisy_bound / found.noisy_error) ** 0.5)
    out.add_section()
    terms = [found.inverse_term] + ([forward.forward_term] if forward else [])
    vacuous = "infinite: vacuous" if not np.isfinite(terms).any() else ", ".join(f"{term:.2g}" for term in terms)
    out.add_row("generalisation terms C", vacuous)
    line("pseudo-dimension of T_inv's losses, at most", found.inverse_dimension)
    return out


def draw(path: Path, artifact: Artifact, system: System, measurement_noise: float, name: str) -> None:
    """The PDE's residual over X, and along the motion the error that noise will make."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    motion = record_motion(artifact, system, measurement_noise, 0.0, 100, np.random.default_rng([CERTIFICATE_SEED, 0]))
    panels = 1 + (artifact.forward is not None)
    figure = Figure(figsize=(5.5 * panels, 4.4), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    first, second = (i % system.nx for i in system.portrait)
    size = np.sqrt(noise_variance(artifact, motion.z, measurement_noise))
    order = size.argsort()
    points: Any = axes[-1].scatter(
        motion.x[order, first], motion.x[order, second], c=size[order], s=3, norm=LogNorm(), cmap="viridis"
    )
    figure.colorbar(points, ax=axes[-1], label="predicted rms error")
    axes[-1].set_title(f"error due to noise {measurement_noise:g}, along the motion")
    if artifact.forward is not None:
        n = 150
        x = np.tile(np.mean(system.X, axis=1), (n * n, 1))
        grids = [np.linspace(*system.X[i], n) for i in (first, second)]
        x[:, first], x[:, second] = (grid.ravel() for grid in np.meshgrid(*grids))
        image: Any = axes[0].pcolormesh(
            *grids, np.linalg.norm(residual(artifact, system, x), axis=1).reshape(n, n), norm=LogNorm(), shading="auto"
        )
        figure.colorbar(image, ax=axes[0], label="|∂T/∂x f − A T − B h|")
        axes[0].set_title("PDE residual over X" if system.nx == 2 else "PDE residual through the centre of X")
    for ax in axes:
        ax.set(xlabel=system.state_names[first], ylabel=system.state_names[second])
    figure.suptitle(name)
    figure.savefig(path, dpi=110)
