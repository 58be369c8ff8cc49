"""``python -m examples.research certify``: a certificate as table, JSON and figure."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from kkl_gym.system import System
from observers import Artifact, KKLObserver
from training import markdown
from training.commands.options import (
    NoiseLevel,
    Observers,
    OwnPolicy,
    OwnSystem,
    model_of,
    read_observers,
    read_policy,
)
from training.evaluation.levels import beyond, level_for, show_level
from training.figures import drawing
from training.files import require_writable, write
from training.progress import progress_bars

if TYPE_CHECKING:
    from examples.research.certificates.certificate import Certificate
    from examples.research.certificates.settled import SettledTrajectories

SHOWN = 30_000  # states in the figure
POINTS = 150  # along each axis, at which the residual is drawn


@dataclass(frozen=True)
class Certify:
    """Say how far an observer is to be trusted: learned maps, sensitivities, noise, and the paper's bounds.

    Prints a table and writes table.md, and for each observer NAME.json and NAME.png.
    docs/background/certificates.md explains each line.
    """

    observers: Observers
    """Shipped maps, or .safetensors files."""
    system: OwnSystem = None
    policy: OwnPolicy = None
    measurement_noise: NoiseLevel = None
    """Standard deviation of the noise on each sample of y, or one for each output as in 0.1,0.3. For the theorems it is
    cut at three of these. Maps that were trained for less are left out."""
    process_noise: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's)")] = None
    """Bound of the process noise, in multiples of the system's scale per second."""
    psi: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the motion's diameter)")] = None
    """Bound of how far process noise moves the state from where it would have been."""
    trajectories: int = 200
    """Number of trajectories, from starts uniform in X."""
    delta: float = 0.05
    """Probability with which each generalisation term may fail."""
    seed: int = 0
    """Seed of starts and noise."""
    out: Path = Path("runs/certificates")
    """Folder of results."""

    def run(self, console: Console) -> "list[Certificate]":
        """Certify."""
        from examples.research.certificates.certificate import certify  # torch takes seconds to import
        from examples.research.certificates.settled import record_settled

        names = [Path(given).stem if given.endswith(".safetensors") else given for given in self.observers]
        if len(set(names)) < len(names):
            raise ValueError(f"each observer writes NAME.json, so names must differ; got {', '.join(names)}")
        certificates = []
        observers = read_observers(self.observers, self.system)
        require_writable(self.out)
        for name, (_, artifact, system) in zip(names, observers, strict=True):
            system = model_of(artifact, system)
            level = level_for(artifact, system, self.measurement_noise)
            if reason := beyond(artifact, level):
                console.print(f"{name}, left out: {reason}", markup=False, highlight=False, soft_wrap=True)
                continue
            title = name
            if artifact.motion is not None:
                artifact, title = replace(artifact, motion=None), f"{name}, T_inv alone"
                console.print(f"{name} tracks; this is the certificate of its T_inv alone", markup=False)
            process_noise = system.process_noise if self.process_noise is None else self.process_noise
            KKLObserver(artifact, level, process_noise=process_noise)  # refuses bad levels now
            noise: dict[str, Any] = {"measurement_noise": level, "process_noise": process_noise}
            with progress_bars(console) as progress, progress.phase(f"certifying {name}"):
                policy = read_policy(artifact, system, self.policy)
                how = {**noise, "trajectories": self.trajectories, "seed": self.seed}
                motion = record_settled(artifact, system, **how, policy=policy)
                certificate = certify(
                    artifact, system, **how, psi=self.psi, delta=self.delta, name=title, recorded=motion
                )
                write(self.out / f"{name}.json", json.dumps(certificate.as_json(), indent=1, allow_nan=False) + "\n")
                draw(self.out / f"{name}.png", artifact, system, name=title, noise=noise, motion=motion)
            certificates.append(certificate)
        if not certificates:
            raise ValueError(f"nothing is left to certify of {', '.join(names)}: the lines above say why")
        console.print(table(certificates))
        write(self.out / "table.md", page(certificates))
        console.print(f"wrote table.md, JSON and figures in {self.out}")
        return certificates


def lines(certificate: "Certificate") -> list[dict[str, str]]:
    """The lines of a certificate in sections, by label; those that need T only where there is one."""
    one, T = certificate, certificate.forward
    learned, forgotten, bounds, noisy_bounds, samples = {}, {}, {}, {}, {}
    if T is not None:
        learned = {
            "R_T, z - T(x) along the motion, mean square": _number(T.forward_risk),
            "PDE residual P, mean square over X": _number(T.pde_risk),
            **{f"\\|P\\|, {100 * level:g} % of X below": _number(value) for level, value in T.residual.items()},
            "R_2, x - T_inv(T(x)) along the motion, mean square": _number(T.reconstruction_risk),
            "the same over X": _number(T.reconstruction_risk_over_box),
            "T_inv(T(x)) - T_inv(z) along the motion, mean square": _number(T.propagated_risk),
        }
        forgotten = {
            **{f"start's \\|z - T(x)\\|, at most, at {age:g} s": _number(left) for age, left in T.envelope.items()},
            "start forgotten after, s": _number(T.forgets_start),
        }
        share = 1 - (T.reconstruction_risk / T.sharp_bound) ** 0.5 if T.sharp_bound > 0 else np.nan
        bounds = {
            "bound of the rms error, no noise": _number(T.bound**0.5),
            "bound / measured": _ratio(T.bound, one.error),
            "share of T in the bound, %": _number(100 * T.forward_share),
            "Lipschitz constant of T_inv from T(x) to z, at most": _number(T.lipschitz_between),
            "sharp bound, no noise": _number(T.sharp_bound**0.5),
            "share of T in it, %": _number(100 * share),
            "sharp bound / measured": _ratio(T.sharp_bound, one.error),
        }
        noisy_bounds = {
            "bound with noise / measured": _ratio(T.noisy_bound, one.noisy_error),
            "sharp bound with noise / measured": _ratio(T.sharp_noisy_bound, one.noisy_error),
        }
        samples = {"N_1, samples of T": _number(T.forward_samples)}
    return [
        {
            "rms error in the long run, no noise": _number(one.error**0.5),
            "the same, v and w bounded": _number(one.noisy_error**0.5),
            "rms error by state in % of its standard deviation, no noise": " / ".join(map(_number, one.nrmse)),
            "the same by state, v and w bounded": " / ".join(map(_number, one.noisy_nrmse)),
            "error due to v alone, predicted": _number(one.predicted_noise_error),
            "the same, measured": _number(one.measured_noise_error),
        },
        {
            "Lipschitz constant of T_inv, at least": _number(one.lipschitz_lower),
            "the same, at most": _number(one.lipschitz_upper),
            "product of the layers' norms": _number(one.norm_product),
            "largest norm of dh/dx over X": _number(one.output_lipschitz),
            "least singular value of [A - s I, B]": _number(one.controllability),
            "gain from v to z, the theorem's": _number(one.gain_theorem),
            "H-infinity norm": _number(one.gain_h_infinity),
            "H2 norm": _number(one.gain_h2),
        },
        learned,
        forgotten,
        {
            "psi": _number(one.psi),
            **bounds,
            "what the theorem adds for noise, as rms": _number(one.noise_term**0.5),
            **noisy_bounds,
        },
        {
            **samples,
            "N_2, samples of T_inv": _number(one.inverse_samples),
            "pseudo-dimension of T_inv's losses, at most": _number(one.inverse_dimension),
            "generalisation term C of T_inv": _number(one.inverse_term),
            **({} if T is None else {"generalisation term C of T": _number(T.forward_term)}),
        },
    ]


def _number(value: float) -> str:
    return "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.3g}"


def _ratio(bound: float, error: float) -> str:
    return _number((bound / error) ** 0.5 if error > 0 else np.nan)


def table(certificates: "Sequence[Certificate]") -> Table:
    """Certificates side by side, one row for each label."""
    out = Table("", *(one.observer for one in certificates))
    for section in _sections(certificates):
        for label, *values in section:
            out.add_row(label.replace("\\", ""), *values)
        out.add_section()
    return out


def page(certificates: "Sequence[Certificate]") -> str:
    """Certificates side by side in Markdown, with the noise that they were made for."""
    rows = [row for section in _sections(certificates) for row in section]
    noise = dict.fromkeys(
        f"{show_level(one.measurement_noise)}, cut at {show_level(one.noise_bound)} for the bounds"
        for one in certificates
    )
    head = f"Measurement noise {'; '.join(noise)}; {certificates[0].samples} samples along the motion of the first.\n\n"
    return head + "\n".join(markdown.table(["", *(one.observer for one in certificates)], rows)) + "\n"


def _sections(certificates: "Sequence[Certificate]") -> list[list[list[str]]]:
    """Rows of each section: a label, and what each certificate has under it."""
    out = []
    for sections in zip(*map(lines, certificates), strict=True):
        longest_first = sorted(sections, key=len, reverse=True)  # those without T lack lines that others have
        labels = dict.fromkeys(label for section in longest_first for label in section)
        out.append([[label, *(section.get(label, "–") for section in sections)] for label in labels])
    return [rows for rows in out if rows]


def draw(
    path: Path,
    artifact: Artifact,
    system: System,
    *,
    name: str,
    noise: Mapping[str, Any],
    motion: "SettledTrajectories",
) -> None:
    """Draw the PDE's residual over X, and along the motion the error that noise will make."""
    from matplotlib.colors import LogNorm

    from examples.research.certificates.gains import noise_variance

    panels = 1 + (artifact.forward is not None)
    with drawing(path, 5 * panels, 4) as figure:
        axes = figure.subplots(1, panels, squeeze=False)[0]
        first, second = (i % system.nx for i in system.portrait)
        shown = np.random.default_rng(0).permutation(len(motion.x))[:SHOWN]
        variance = noise_variance(artifact, motion.z[shown], **noise)
        x, size = motion.x[shown], np.sqrt(variance)
        order = size.argsort()
        points: Any = axes[-1].scatter(
            x[order, first], x[order, second], c=size[order], s=3, norm=LogNorm() if size.all() else None
        )
        figure.colorbar(points, ax=axes[-1], label="predicted rms error")
        axes[-1].set_title(f"error due to noise {show_level(noise['measurement_noise'])}, along the motion")
        axes[-1].set(xlabel=system.state_names[first], ylabel=system.state_names[second])
        if artifact.forward is not None:
            draw_residual(axes[0], artifact, system)
        figure.suptitle(name)


def draw_residual(ax: Any, artifact: Artifact, system: System) -> None:
    """Draw the size of the PDE's residual over the plane of the phase portrait, other states at the centre of X."""
    from matplotlib.colors import LogNorm

    from training.maps.forward import residual

    first, second = (i % system.nx for i in system.portrait)
    x = np.tile(np.mean(system.X, axis=1), (POINTS**2, 1))
    grids = [np.linspace(*system.X[i], POINTS) for i in (first, second)]
    x[:, first], x[:, second] = (grid.ravel() for grid in np.meshgrid(*grids))
    size = np.linalg.norm(residual(artifact, system, x), axis=1).reshape(POINTS, POINTS)
    image = ax.pcolormesh(*grids, size, norm=LogNorm() if size.all() else None, shading="auto")
    ax.figure.colorbar(image, ax=ax, label="|∂T/∂x f − A T − B h|")
    ax.set(xlabel=system.state_names[first], ylabel=system.state_names[second])
    ax.grid(visible=False)
    ax.set_title("PDE residual over X" if system.nx == 2 else "PDE residual through the centre of X")
