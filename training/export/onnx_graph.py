"""An observer's step as an ONNX graph, which Torch exports from :class:`TorchObserver`."""

import json
import logging
import warnings
from typing import Any

import torch
from torch import Tensor

import kkl_gym
from training.export.exported import Exported
from training.export.torch_observer import TorchObserver

OPSET = 18


def onnx_model(exported: Exported) -> Any:
    """Return the ONNX model of the step, with metadata."""
    import onnx_ir
    from onnx import checker, helper
    from onnxscript import opset18

    def scalar(s: float, dtype: int = 1, layout: str = "", device: str = "", pin_memory: bool = False) -> Any:
        """Translate a number to a constant of its type; Torch's own translation would turn doubles into floats."""
        value: Any = onnx_ir.tensor(s, dtype=onnx_ir.DataType(dtype))
        return opset18.Constant(value=value)

    artifact, dtype = exported.artifact, {"float": torch.float32, "double": torch.float64}[exported.precision]
    measurement_noise, process_noise = exported.measurement_noise, exported.process_noise
    step = _Step(artifact, measurement_noise, process_noise=process_noise, dtype=dtype).requires_grad_(False).eval()
    widths = {"y": artifact.ny, "u": artifact.nu, "measurement_noise": len(exported.levels), "process_noise": 1}
    example: dict[str, Tensor | None] = {"state": step.start(2)}
    example |= {name: torch.zeros(2, width, dtype=dtype) if width else None for name, width in widths.items()}
    batch = torch.export.Dim("batch")
    # Torch would warn that torchvision is missing, and of problems in its own code.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            step,
            tuple(example.values()),
            input_names=[name for name, value in example.items() if value is not None],
            output_names=["state_next", "x_hat", *["covariance"] * hasattr(step.driven, "error")],
            opset_version=OPSET,
            dynamic_shapes=[None if value is None else {0: batch} for value in example.values()],
            custom_translation_table={torch.ops.aten.scalar_tensor.default: scalar},
            dynamo=True,
            optimize=False,  # ONNX Runtime optimises models on loading, faster than Torch would here
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    for node in model.graph.node:
        del node.metadata_props[:]  # Torch's notes on each node's origin, which would make up most of the file
    model.graph.name = exported.name
    model.graph.doc_string = f"One step of the KKL observer {exported.source}. A state row of zeros marks a start."
    model.producer_name, model.producer_version = "kkl-gym", kkl_gym.__version__
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in exported.metadata.items()}
    helper.set_model_props(model, texts)
    checker.check_model(model, full_check=True)
    return model


class _Step(TorchObserver):
    """A step that also returns the covariances of the estimates, if T_inv has a covariance."""

    def forward(  # type: ignore[override]
        self, state: Tensor, y: Tensor, u: Tensor | None, measurement_noise: Tensor | None, process_noise: Tensor | None
    ) -> tuple[Tensor, ...]:
        state, x_hat = super().forward(state, y, u, measurement_noise, process_noise)
        if not hasattr(self.driven, "error"):
            return state, x_hat
        return state, x_hat, self.covariance(state, measurement_noise, process_noise).to(x_hat.dtype)
