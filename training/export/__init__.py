"""An observer's step in Torch, ONNX and C99, without known initial states, monitor, outlier gate and sample delay."""
