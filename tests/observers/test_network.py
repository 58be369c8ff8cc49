import numpy as np
import pytest

from observers import MLP


def layers(*sizes):
    rng = np.random.default_rng(3)
    pairs = list(zip(sizes[1:], sizes[:-1], strict=True))
    return [rng.normal(size=p).astype(np.float32) for p in pairs], [
        rng.normal(size=b).astype(np.float32) for b, _ in pairs
    ]


@pytest.mark.parametrize(("activation", "module"), [("tanh", "Tanh"), ("silu", "SiLU")])
@pytest.mark.parametrize(("sizes", "batch"), [((3, 2), (2, 3)), ((7, 32, 32, 32, 2), ())])
def test_mlp_equals_torch(activation, module, sizes, batch):
    torch = pytest.importorskip("torch")
    weights, biases = layers(*sizes)
    steps = []
    for weight, bias in zip(weights, biases, strict=True):
        linear = torch.nn.Linear(*weight.shape[::-1])
        linear.load_state_dict({"weight": torch.from_numpy(weight), "bias": torch.from_numpy(bias)})
        steps += [linear, getattr(torch.nn, module)()]
    x = 3 * np.random.default_rng(4).normal(size=(*batch, sizes[0]))
    kept = x.copy()
    with torch.no_grad():
        expected = torch.nn.Sequential(*steps[:-1])(torch.from_numpy(x).float()).numpy()
    mlp = MLP(weights, biases, activation)
    assert (mlp.inputs, mlp.outputs) == (sizes[0], sizes[-1])
    out = mlp(x)
    assert out.dtype == np.float32
    assert np.allclose(out, expected, rtol=1e-4, atol=1e-4)
    assert np.allclose(mlp(x.astype(np.float32)), out, rtol=1e-6)
    assert np.array_equal(x, kept)
