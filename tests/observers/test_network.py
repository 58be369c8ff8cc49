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


def test_mlp_shape_errors():
    weights, biases = layers(3, 4, 2)
    for wrong in (
        (weights, biases[:1]),
        ([], []),
        (weights[::-1], biases[::-1]),
        (weights, [biases[0], biases[0]]),
        (weights, [biases[0][:, None], biases[1]]),
        ([weights[0][0], weights[1]], biases),
        ([weights[0], np.full((2, 4), np.nan)], biases),
        (weights, [biases[0], np.full(2, np.inf)]),
        ([weights[0], np.full((2, 4), 1e300)], biases),  # infinite as float32
    ):
        with pytest.raises(ValueError, match=r"cannot follow|do not make|not finite|must be"):
            MLP(*wrong, "tanh")
    with pytest.raises(ValueError, match="activation must be 'tanh' or 'silu' or 'relu', got 'gelu'"):
        MLP(weights, biases, "gelu")
