"""The figures on the pages about certificates are those of the committed certificates."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from kkl_gym import get_system
from observers import Artifact, LinearFilter
from observers.names import resolve
from training import certify

DOCS = Path(__file__).parents[3] / "docs"


def page():
    both = [(DOCS / room / "certificates.md").read_text() for room in ("background", "results")]
    return " ".join(" ".join(both).split())


def committed():
    found = [json.loads(path.read_text()) for path in (DOCS / "results" / "certificates").glob("*.json")]
    assert len(found) == 8
    return found


@pytest.mark.parametrize(
    ("sentence", "larger", "smaller"),
    [
        (r"It is ([\d.]+) to ([\d.,]+) times smaller than the product", "norm_product", "lipschitz_upper"),
        (r"and ([\d.]+) to ([\d.,]+) times larger than the lower figure", "lipschitz_upper", "lipschitz_lower"),
        (r"it is ([\d.]+) to ([\d.,]+) times less than the first", "gain_theorem", "gain_h2"),
    ],
)
def test_ratios(sentence, larger, smaller):
    ratios = [one[larger] / one[smaller] for one in committed()]
    low, high = (float(value.replace(",", "")) for value in re.search(sentence, page()).groups())
    assert (low, high) == pytest.approx((min(ratios), max(ratios)), rel=0.05)


def test_the_sharp_bound():
    sentence = (
        r"the sharp bound is (\d+) to ([\d,]+) times the measured rms error, "
        r"where the printed one is ([\d,]+) to ([\d,]+)"
    )
    said = [float(value.replace(",", "")) for value in re.search(sentence, page()).groups()]
    for (low, high), name in zip((said[:2], said[2:]), ("sharp_bound", "bound"), strict=True):
        ratios = [(one["forward"][name] / one["error"]) ** 0.5 for one in committed() if one["forward"]]
        assert (low, high) == pytest.approx((min(ratios), max(ratios)), rel=0.05)
    parts = [one["forward"] for one in committed() if one["forward"]]
    ratios = [(part["steep_risk"] / part["propagated_risk"]) ** 0.5 for part in parts]
    assert "the estimate 256 to 3,290 times less than the sharp bound says" in page()
    assert (min(ratios), max(ratios)) == pytest.approx((256, 3290), rel=0.05)
    assert max(part["reconstruction_risk"] / part["steep_risk"] for part in parts) < 1e-5
    shares = [one["forward"]["forward_share"] for one in committed() if one["forward"]]
    assert min(shares) > 0.9  # "Nearly all of the first bound is T's term."


def test_the_right_observer_beside_a_wrong_filter():
    right = json.loads((DOCS / "results" / "certificates" / "reverse_duffing-spinn.json").read_text())
    forward = right["forward"]
    assert f"an rms error of 0.42 in place of {right['error'] ** 0.5:.2g}." in page()
    assert f"The right observer's bound, {forward['bound'] ** 0.5:.0f}, is" in page()
    assert f"0.12 in place of {forward['physics_risk']:.8f}." in page()


@pytest.mark.slow
def test_the_wrong_filter():
    artifact = Artifact.read(resolve("reverse_duffing-spinn"))
    linear = artifact.filter
    wrong = dataclasses.replace(artifact, filter=LinearFilter(1.3 * linear.A, linear.B, linear.dt))
    found = certify(wrong, get_system("reverse_duffing"))
    assert found.error**0.5 == pytest.approx(0.42, abs=0.005)
    assert found.forward.physics_risk == pytest.approx(0.12, abs=0.005)
