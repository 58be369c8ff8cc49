"""An observer's step outside NumPy: as a module of Torch, as ONNX, and as C99, without known starts and monitor."""
