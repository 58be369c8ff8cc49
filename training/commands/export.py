"""``kkl-gym export MAP``: an observer for programs without Python."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from observers.storage import replacing, write
from training.commands.options import NoiseLevel

if TYPE_CHECKING:
    from training.export import Exported


@dataclass(frozen=True)
class ExportCommand:
    """Export an observer for programs without Python: as an ONNX graph, as C99, or for JavaScript.

    All take in a sample and the input before it, and give the filter's next state and the estimate, as
    observers.KKLObserver does. All maps can be exported: those that ship, of your own systems, from records and from
    rollouts. Missing samples are in JavaScript and, of maps that track, in the others. The monitor is in JavaScript
    alone.

    --format onnx: NAME.onnx, which takes a batch of any size, and levels of noise as inputs. It needs the extra onnx.
    --format c: NAME.h and NAME.c, which allocate nothing and need the C library alone, and NAME_main.c, a program that
    reads samples and prints estimates. --format js: NAME_step.safetensors, the constants, and kkl_observer.js, a module
    for browsers and Node that reads them. docs/guides/export.md goes from end to end.
    """

    observer: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP", help="A shipped map, or a .safetensors file.")
    ]
    format: Literal["onnx", "c", "js"]
    """What to write."""
    precision: Literal["float", "double"] = "float"
    """Type of the network, of samples and of estimates; JavaScript knows doubles alone. The filter is of doubles in any
    case, because its small differences are inputs of the network. So is the covariance of maps
    that track."""
    measurement_noise: Annotated[NoiseLevel, tyro.conf.arg(help_behavior_hint="(default: the map's usual one)")] = None
    """For --format c and js: standard deviation of the noise on each sample that the estimate assumes, or one for each
    output as in 0.1,0.3. The module's tell changes it."""
    process_noise: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: the system's)")] = None
    """For --format c and js: level of process noise that the estimate assumes, likewise."""
    out: Path = Path("runs/export")
    """Folder for the files."""

    def run(self, console: Console) -> list[Path]:
        """Export."""
        from training.export import Exported

        if self.format == "onnx" and (self.measurement_noise, self.process_noise) != (None, None):
            raise ValueError(
                "levels of noise are inputs of an ONNX graph: leave out --measurement-noise and --process-noise"
            )
        exported = Exported.read(
            self.observer,
            precision=self.precision,
            measurement_noise=self.measurement_noise,
            process_noise=self.process_noise,
        )
        if self.format == "onnx":
            return [self._onnx(exported, console)]
        return self._c(exported, console) if self.format == "c" else self._js(exported, console)

    def _onnx(self, exported: "Exported", console: Console) -> Path:
        from training.export.onnx_graph import onnx_model

        content = onnx_model(exported).SerializeToString()
        path = self.out / f"{exported.name}.onnx"
        with replacing(path) as temporary:
            temporary.write_bytes(content)
        _say(console, f"wrote {path}, {len(content) / 1e3:.0f} kB")
        return path

    def _c(self, exported: "Exported", console: Console) -> list[Path]:
        from training.export.c_source import c_files
        from training.export.footprint import footprint

        files = {self.out / name: text for name, text in c_files(exported).items()}
        for path, text in files.items():
            write(path, text)
        _say(console, f"wrote {', '.join(map(str, files))}")
        found = footprint(self.out / f"{exported.name}.c")
        _say(console, str(found) if found else "there is no cc or no size here, which would tell how large it is")
        return list(files)

    def _js(self, exported: "Exported", console: Console) -> list[Path]:
        from training.export.step_file import javascript, write_step

        constants, module = self.out / f"{exported.name}_step.safetensors", self.out / "kkl_observer.js"
        write_step(constants, exported)
        write(module, javascript())
        _say(console, f"wrote {constants}, {constants.stat().st_size / 1e3:.0f} kB, and {module}")
        return [constants, module]


def _say(console: Console, text: str) -> None:
    """Print a line of which nothing is markup, and which is not broken where paths are to be copied."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)
