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
from observers.storage import require_writable, write
from training import markdown
from training.commands.options import NoiseLevel, Observers, OwnPolicy, OwnSystem, read_observers, read_policy
from training.evaluation.levels import beyond, level_for, show_level
from training.figures import drawing
from training.progress import progress_bars

if TYPE_CHECKING:
    from examples.research.certificates.certificate import Certificate
    from examples.research.certificates.settled import SettledTrajectories

SHOWN = 30_000  # states in the figure


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
        from examples.research.certificates.certificate import certify, parts  # torch takes seconds to import
        from examples.research.certificates.settled import record_settled

        names = [Path(given).stem if given.endswith(".safetensors") else given for given in self.observers]
        if len(set(names)) < len(names):
            raise ValueError(f"each observer writes NAME.json, so names must differ; got {', '.join(names)}")
        found = []
        observers = read_observers(self.observers, self.system)
        require_writable(self.out)
        for name, (_, artifact, system) in zip(names, observers, strict=True):
            level = level_for(artifact, system, self.measurement_noise)
            if reason := beyond(artifact, level):
                console.print(f"{name}, left out: {reason}", markup=False, highlight=False, soft_wrap=True)
                continue
            title = name
            if artifact.flow is not None:
                artifact, title = replace(artifact, flow=None), f"{name}, T_inv alone"
                console.print(f"{name} tracks; this is the certificate of its T_inv alone", markup=False)
            process_noise = system.process_noise if self.process_noise is None else self.process_noise
            KKLObserver(artifact, level, process_noise=process_noise)  # refuses bad levels now
            noise: dict[str, Any] = {"measurement_noise": level, "process_noise": process_noise}
            with progress_bars(console) as progress, progress.phase(f"certifying {name}", parts(artifact)) as report:
                policy = read_policy(artifact, system, self.policy)
                motion = record_settled(
                    artifact,
                    system,
                    **noise,
                    trajectories=self.trajectories,
                    seed=self.seed,
                    policy=policy,
                )
                certificate = certify(
                    artifact,
                    system,
                    **noise,
                    psi=self.psi,
                    trajectories=self.trajectories,
                    delta=self.delta,
                    seed=self.seed,
                    name=title,
                    recorded=motion,
                    report=report,
                )
                write(self.out / f"{name}.json", json.dumps(certificate.as_json(), indent=1, allow_nan=False) + "\n")
                draw(self.out / f"{name}.png", artifact, system, name=title, noise=noise, motion=motion)
            found.append(certificate)
        if not found:
            raise ValueError(f"nothing is left to certify of {', '.join(names)}: the lines above say why")
        console.print(table(found))
        write(self.out / "table.md", page(found))
        console.print(f"wrote table.md, JSON and figures in {self.out}")
        return found


def lines(found: "Certificate") -> list[dict[str, str]]:
    """The lines of a certificate in sections, by label."""
    from examples.research.certificates.forward import QUANTILES

    forward = found.forward

    def number(value: float | None) -> str:
        return "–" if value is None or np.isnan(value) else "∞" if np.isinf(value) else f"{value:.3g}"

    def of(name: str) -> str:
        return number(getattr(forward, name, None))

    def ratio(bound: float, error: float) -> str:
        return number((bound / error) ** 0.5 if error > 0 else None)

    def states(values: Sequence[float]) -> str:
        return " / ".join(map(number, values))

    residual = {f"\\|P\\|, {100 * level:g} % of X below": level for level in QUANTILES}
    left = forward.envelope if forward else {}
    return [
        {
            "rms error in the long run, no noise": number(found.error**0.5),
            "the same, v and w bounded": number(found.noisy_error**0.5),
            "rms error by state in % of its standard deviation, no noise": states(found.nrmse),
            "the same by state, v and w bounded": states(found.noisy_nrmse),
            "error due to v alone, predicted": number(found.predicted_noise_error),
            "the same, measured": number(found.measured_noise_error),
        },
        {
            "Lipschitz constant of T_inv, at least": number(found.lipschitz_lower),
            "the same, at most": number(found.lipschitz_upper),
            "product of the layers' norms": number(found.norm_product),
            "largest norm of dh/dx over X": number(found.output_lipschitz),
            "least singular value of [A - s I, B]": number(found.controllability),
            "gain from v to z, the theorem's": number(found.gain_theorem),
            "H-infinity norm": number(found.gain_h_infinity),
            "H2 norm": number(found.gain_h2),
        },
        {
            "R_T, z - T(x) along the motion, mean square": of("forward_risk"),
            "PDE residual P, mean square over X": of("pde_risk"),
            **{label: number(forward.residual[level] if forward else None) for label, level in residual.items()},
            "R_2, x - T_inv(T(x)) along the motion, mean square": of("reconstruction_risk"),
            "the same over X": of("reconstruction_risk_over_box"),
            "T_inv(T(x)) - T_inv(z) along the motion, mean square": of("propagated_risk"),
        },
        {
            **{f"start's \\|z - T(x)\\|, at most, at {age:g} s": number(value) for age, value in left.items()},
            "start forgotten after, s": of("forgets_start"),
        },
        {
            "psi": number(found.psi),
            "bound of the rms error, no noise": number(forward.bound**0.5 if forward else None),
            "bound / measured": number(None) if forward is None else ratio(forward.bound, found.error),
            "share of T in the bound, %": number(100 * forward.forward_share if forward else None),
            "Lipschitz constant of T_inv from T(x) to z, at most": of("lipschitz_between"),
            "sharp bound, no noise": number(forward.sharp_bound**0.5 if forward else None),
            "share of T in it, %": number(100 * (1 - (forward.reconstruction_risk / forward.sharp_bound) ** 0.5))
            if forward and forward.sharp_bound > 0
            else number(None),
            "sharp bound / measured": number(None) if forward is None else ratio(forward.sharp_bound, found.error),
            "what the theorem adds for noise, as rms": number(found.noise_term**0.5),
            "bound with noise / measured": number(None)
            if forward is None
            else ratio(forward.noisy_bound, found.noisy_error),
            "sharp bound with noise / measured": number(None)
            if forward is None
            else ratio(forward.sharp_noisy_bound, found.noisy_error),
        },
        {
            "N_1, samples of T": of("forward_samples"),
            "N_2, samples of T_inv": number(found.inverse_samples),
            "pseudo-dimension of T_inv's losses, at most": number(found.inverse_dimension),
            "generalisation term C of T_inv": number(found.inverse_term),
            "generalisation term C of T": of("forward_term"),
        },
    ]


def table(found: "Sequence[Certificate]") -> Table:
    """Certificates side by side, one row for each label."""
    out = Table("", *(certificate.observer for certificate in found))
    for section in _sections(found):
        for label, *values in section:
            out.add_row(label.replace("\\", ""), *values)
        out.add_section()
    return out


def page(found: "Sequence[Certificate]") -> str:
    """Certificates side by side in Markdown, with the noise that they were made for."""
    rows = [row for section in _sections(found) for row in section]
    noise = dict.fromkeys(
        f"{show_level(one.measurement_noise)}, cut at {show_level(one.noise_bound)} for the bounds" for one in found
    )
    head = f"Measurement noise {'; '.join(noise)}; {found[0].samples} samples along the motion of the first.\n\n"
    return head + "\n".join(markdown.table(["", *(certificate.observer for certificate in found)], rows)) + "\n"


def _sections(found: "Sequence[Certificate]") -> list[list[list[str]]]:
    """Rows of each section: a label, and what each certificate has under it."""
    out = []
    for sections in zip(*map(lines, found), strict=True):
        longest_first = sorted(sections, key=len, reverse=True)  # some lack lines that others have
        labels = dict.fromkeys(label for section in longest_first for label in section)
        out.append([[label, *(section.get(label, "–") for section in sections)] for label in labels])
    return out


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
    from training.evaluation.report import draw_residual

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
