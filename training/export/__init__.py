"""An observer's step outside NumPy, without known starts and monitor: as a module of Torch, as ONNX, and as C99."""
