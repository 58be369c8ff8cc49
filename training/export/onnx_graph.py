"""The step as an ONNX graph: :class:`TorchObserver`, exported by Torch."""

import json
import logging
import warnings
from typing import Any

import torch
from torch import Tensor, nn

import kkl_gym
from training.export.exported import Exported
from training.export.torch_observer import TorchObserver

OPSET = 18


def onnx_model(exported: Exported) -> Any:
    """Export the graph, and describe the observer in its metadata.

    Inputs and outputs have a row for each observer of a batch: those of :meth:`TorchObserver.forward`, of which
    ``u`` and levels are inputs as far as the observer depends on them, and the calibrated ``covariance``.
    """
    import onnx_ir
    from onnx import checker, helper
    from onnxscript import opset18

    def scalar(s: float, dtype: int = 1, layout: str = "", device: str = "", pin_memory: bool = False) -> Any:
        """Torch's own translation makes floats of doubles."""
        value: Any = onnx_ir.tensor(s, dtype=onnx_ir.DataType(dtype))
        return opset18.Constant(value=value)

    artifact, dtype = exported.artifact, {"float": torch.float32, "double": torch.float64}[exported.precision]
    levels = exported.measurement_noise, exported.process_noise
    observer = TorchObserver(artifact, levels[0], process_noise=levels[1], dtype=dtype).requires_grad_(False)
    n = 2  # rows of an example; the graph takes any number
    given: dict[str, Tensor | None] = {"state": observer.start(n), "y": torch.zeros(n, artifact.ny, dtype=dtype)}
    widths = {"u": artifact.nu, "measurement_noise": len(exported.levels)}
    widths["process_noise"] = int(exported.needs_process_noise)
    given |= {name: torch.zeros(n, width, dtype=dtype) if width else None for name, width in widths.items()}
    outputs = ["state_next", "x_hat", *["covariance"] * (artifact.inverse.error_covariance is not None)]
    batch = torch.export.Dim("batch")
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)  # torchvision is no loss
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Torch about itself
        program = torch.onnx.export(
            _Step(observer, len(outputs) > 2).eval(),
            tuple(given.values()),
            input_names=[name for name, value in given.items() if value is not None],
            output_names=outputs,
            opset_version=OPSET,
            dynamic_shapes=[None if value is None else {0: batch} for value in given.values()],
            custom_translation_table={torch.ops.aten.scalar_tensor.default: scalar},
            dynamo=True,
            optimize=False,  # ONNX Runtime does so in a second, Torch in ten
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    for node in model.graph.node:
        del node.metadata_props[:]  # where in Torch it came from, most of the file
    model.graph.name = exported.name
    model.graph.doc_string = f"One step of the KKL observer {exported.source}; a row whose state is zeros starts again."
    model.producer_name, model.producer_version = "kkl-gym", kkl_gym.__version__
    texts = {key: said if isinstance(said, str) else json.dumps(said) for key, said in exported.described.items()}
    helper.set_model_props(model, texts)
    checker.check_model(model, full_check=True)
    return model


class _Step(nn.Module):
    """A step, and the covariances after it."""

    def __init__(self, observer: TorchObserver, covariance: bool) -> None:
        super().__init__()
        self._observer, self._covariance = observer, covariance

    def forward(
        self, state: Tensor, y: Tensor, u: Tensor | None, measurement_noise: Tensor | None, process_noise: Tensor | None
    ) -> tuple[Tensor, ...]:
        state, x_hat = self._observer(state, y, u, measurement_noise, process_noise)
        if not self._covariance:
            return state, x_hat
        return state, x_hat, self._observer.covariance(state, measurement_noise, process_noise).to(x_hat.dtype)
