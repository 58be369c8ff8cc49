"""One step of an optimisation in tensors that stay in place, so that a CUDA graph can hold it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import nn

# A batch is drawn with the generator it is given and nothing else, so that a resumed run goes on as it would have.
Loss = Callable[[torch.Generator], dict[str, torch.Tensor]]


class Step:
    """One batch: draw, loss, gradients, clipping, Adam's step and the sum of errors, in tensors that stay in place.

    SOAP steps after it, because its eigenvectors cannot be part of a CUDA graph.
    """

    def __init__(
        self, module: nn.Module, loss: Loss, optimiser: torch.optim.Optimizer, generator: torch.Generator
    ) -> None:
        self.module, self.loss, self.optimiser, self.generator = module, loss, optimiser, generator
        self.optimises = isinstance(optimiser, torch.optim.Adam)
        device = next(module.parameters()).device
        self.total, self.terms = torch.zeros((), device=device), dict[str, torch.Tensor]()
        if self.optimises and device.type == "cuda":  # a graph would keep a number as it was when captured
            for group in optimiser.param_groups:
                group["lr"] = torch.as_tensor(group["lr"], dtype=torch.float32, device=device)

    def set_learning_rate(self, rate: float) -> None:
        """For the batches that follow."""
        for group in self.optimiser.param_groups:
            if isinstance(group["lr"], torch.Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def __call__(self) -> None:
        """Run it."""
        terms = self.loss(self.generator)
        self.optimiser.zero_grad(set_to_none=True)
        terms["loss"].backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.module.parameters(), 1.0)
        if self.optimises:
            self.optimiser.step()
        self.total += terms.get("error", terms["loss"]).detach()
        self.terms = {name: value.detach() for name, value in terms.items()}


class Captured:
    """A function of tensors that stay in place: its first calls run as they are, the others replay a CUDA graph."""

    WARM_UP = 3  # calls in which the optimiser and torch's libraries allocate what they keep

    def __init__(self, function: Callable[[], None], generator: torch.Generator) -> None:
        self._function, self._generator, self._calls = function, generator, 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Run the function, or replay it."""
        if self._calls < self.WARM_UP:
            stream, current = torch.cuda.Stream(), torch.cuda.current_stream()  # type: ignore[no-untyped-call]
            stream.wait_stream(current)
            with _on_gpu(), torch.cuda.stream(stream):
                self._function()
            current.wait_stream(stream)
        else:
            self._graph = self._graph or self._captured()
            self._graph.replay()
        self._calls += 1

    def _captured(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(self._generator)
        try:
            with _on_gpu(), torch.cuda.graph(graph):
                self._function()
        except RuntimeError as error:
            raise RuntimeError(
                f"a batch cannot be captured as a CUDA graph, as if f or h copied tensors to the host: {error}; train "
                "with --device cpu"
            ) from error
        return graph


@contextmanager
def _on_gpu() -> Iterator[None]:
    """TF32 matrix products, and functions uncompiled that the compiler fails on."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        with torch._dynamo.config.patch(suppress_errors=True):
            yield
    finally:
        torch.set_float32_matmul_precision(before)
