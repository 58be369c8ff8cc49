"""Exported observers, run by ONNX Runtime."""

import numpy as np
import onnxruntime

from training.export.onnx_graph import onnx_model

TYPES = {"tensor(float)": np.float32, "tensor(double)": float}


class Runner:
    """An exported observer, in a batch."""

    def __init__(self, exported):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        model = onnx_model(exported).SerializeToString()
        self.session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        self.exported, self.types = exported, {one.name: one.type for one in self.session.get_inputs()}
        self.widths = {one.name: one.shape[1] for one in self.session.get_inputs()}
        self.names = [one.name for one in self.session.get_outputs()]

    def begun(self, n):
        """States of which nothing is known yet."""
        return {name: np.full((n, width), np.nan) for name, width in self.widths.items() if name in ("z", "tracker")}

    def step(self, states, **given):
        """Estimates, and the next states."""
        n = len(given["y_next"])
        levels = {"measurement_noise": np.tile(self.exported.levels, (n, 1)),
                  "process_noise": np.full((n, 1), self.exported.process_noise)}  # fmt: skip
        given = {**levels, **states, **given}
        inputs = {name: given[name].astype(TYPES[kind]) for name, kind in self.types.items()}
        found = dict(zip(self.names, self.session.run(self.names, inputs), strict=True))
        return found["x_hat"], {name: found[f"{name}_next"] for name in states}

    def along(self, y, u, age=lambda k: k, **given):
        """Estimates along a record of several rows."""
        n, x_hat = y.shape[1], []
        states = self.begun(n)
        for k in range(len(y)):
            ages = np.broadcast_to(age(k), n).reshape(n, 1)
            found, states = self.step(states, y=y[k - 1], u=u[k - 1], y_next=y[k], age=ages, **given)
            x_hat.append(found)
        return np.array(x_hat)
