"""Exported observers, run by ONNX Runtime."""

import numpy as np
import onnxruntime

TYPES = {"tensor(float)": np.float32, "tensor(double)": float}


class Runner:
    """A graph, in a batch."""

    def __init__(self, model):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        self.types = {one.name: one.type for one in self.session.get_inputs()}
        self.width = self.session.get_inputs()[0].shape[1]
        self.names = [one.name for one in self.session.get_outputs()]

    def start(self, n):
        return np.zeros((n, self.width))

    def step(self, state, **given):
        """The outputs by their names."""
        inputs = {name: np.asarray((given | {"state": state})[name], TYPES[kind]) for name, kind in self.types.items()}
        return dict(zip(self.names, self.session.run(self.names, inputs), strict=True))

    def along(self, y, u, measurement_noise, process_noise):
        """Estimates along a record of several rows."""
        n, x_hat = y.shape[1], []
        levels = {
            "measurement_noise": np.tile(measurement_noise, (n, 1)),
            "process_noise": np.full((n, 1), process_noise),
        }
        state = self.start(n)
        for k in range(len(y)):
            found = self.step(state, y=y[k], u=u[k - 1], **levels)
            state = found["state_next"]
            x_hat.append(found["x_hat"])
        return np.array(x_hat)
