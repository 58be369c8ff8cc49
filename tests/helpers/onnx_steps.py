"""Exported observers, run by ONNX Runtime."""

import numpy as np
import onnxruntime

from training.export.onnx_graph import onnx_model


class Runner:
    """An exported observer, in a batch."""

    def __init__(self, exported):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        model = onnx_model(exported).SerializeToString()
        self.session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        self.exported, self.types = exported, {one.name: one.type for one in self.session.get_inputs()}
        self.widths = {one.name: one.shape[1] for one in self.session.get_inputs()}

    def step(self, **given):
        """What the graph gives back, by name."""
        n = len(given["z"])
        given |= {"measurement_noise": np.tile(self.exported.levels, (n, 1)),
                  "process_noise": np.full((n, 1), self.exported.process_noise)}  # fmt: skip
        types = {"tensor(float)": np.float32, "tensor(double)": float}
        inputs = {name: given[name].astype(types[kind]) for name, kind in self.types.items()}
        names = [one.name for one in self.session.get_outputs()]
        return dict(zip(names, self.session.run(names, inputs), strict=True))

    def along(self, y, u):
        """Estimates along a record."""
        n = y.shape[1]
        states = {name: np.full((n, width), np.nan) for name, width in self.widths.items() if name in ("z", "tracker")}
        x_hat = []
        for k in range(len(y)):
            found = self.step(**states, y=y[k - 1], u=u[k - 1], y_next=y[k], age=np.full((n, 1), k))
            states = {name: found[f"{name}_next"] for name in states}  # of the first, nothing was known
            x_hat.append(found["x_hat"])
        return np.array(x_hat)
