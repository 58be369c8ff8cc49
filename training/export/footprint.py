"""How much memory exported C takes, as this machine's compiler has it."""

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

FLAGS = ("-std=c99", "-O2")


@dataclass(frozen=True)
class Footprint:
    """Memory of an observer in C, in bytes."""

    flash: int
    static: int
    state: int

    def __str__(self) -> str:
        return (
            f"flash {self.flash / 1e3:.0f} kB of code and constants, RAM {self.static + self.state:,} bytes for an "
            f"observer, and stack (cc {' '.join(FLAGS)} of this machine)"
        )


def footprint(source: Path) -> Footprint | None:
    """Compile exported C and look at the object."""
    cc, size = shutil.which("cc"), shutil.which("size")
    if cc is None or size is None:
        return None
    name = source.stem
    with tempfile.TemporaryDirectory() as folder:
        variable = Path(folder, "variable.c")
        variable.write_text(f'#include "{name}.h"\n{name}_observer observer = {{{{0}}}};\n', encoding="utf-8")
        try:
            flash, static = _sizes(cc, size, source, Path(folder, "source.o"))
            _, state = _sizes(cc, size, variable, Path(folder, "variable.o"), f"-I{source.parent.resolve()}")
        except (OSError, ValueError, IndexError, subprocess.SubprocessError):
            return None
    return Footprint(flash, static, state)


def _sizes(cc: str, size: str, source: Path, target: Path, *options: str) -> tuple[int, int]:
    """Bytes of code and constants, and of variables."""
    subprocess.run([cc, *FLAGS, *options, "-c", str(source), "-o", str(target)], check=True, capture_output=True)
    printed = subprocess.run([size, str(target)], check=True, capture_output=True, text=True).stdout
    text, data, bss, *_ = map(int, printed.splitlines()[1].split()[:3])
    return text, data + bss
