"""The commands of ``python -m examples.research``, run by the same main function as those of ``kkl-gym``."""

from training.cli import main

COMMANDS = {
    "benchmark": ("examples.research.benchmark.command", "Benchmark"),
    "hyperkkl": ("examples.research.hyperkkl", "HyperKKL"),
    "lipschitz": ("examples.research.lipschitz", "Lipschitz"),
    "agents": ("examples.research.agents.command", "Compare"),
    "kinds": ("examples.research.agents.kinds", "Kinds"),
    "speed": ("examples.research.speed.speed", "Speed"),
    "torch": ("examples.research.speed.torch_steps", "TorchSpeed"),
}
GOES_ON: dict[tuple[str, ...], str] = {
    (name,): "the same command continues" for name in ("benchmark", "agents", "kinds")
}

if __name__ == "__main__":
    main(prog="python -m examples.research", commands=COMMANDS, after_interruption=GOES_ON)
