"""Where an error comes from, on data that are constructed."""

import numpy as np
import pytest
from study_frames import made_up

from femoreg_torch.statistics.origins import explained, relative_origins


def test_independent_groups_share_the_variance_that_they_bring() -> None:
    rng = np.random.default_rng(0)
    a, b, c = (rng.normal(size=(5000, 2)) for _ in range(3))
    response = 2 * a[:, 0] + b[:, 1] + rng.normal(size=5000)  # variances 4, 1, 0 and 1 of 6
    found = explained(response, {"a": a, "b": b, "c": c}, "made up")
    assert [o.share for o in found.origins] == pytest.approx([4 / 6, 1 / 6, 0], abs=0.02)
    assert sum(o.share for o in found.origins) == pytest.approx(found.r2)
    assert [o.partial for o in found.origins] == pytest.approx([4 / 5, 1 / 2, 0], abs=0.02)
    assert found.adjusted < found.r2


def test_groups_that_tell_the_same_share_it_evenly() -> None:
    x = np.random.default_rng(1).normal(size=(300, 1))
    found = explained(3 * x[:, 0], {"one": x, "copy": 5 * x}, "made up")
    assert [o.share for o in found.origins] == pytest.approx([0.5, 0.5])
    assert found.r2 == pytest.approx(1)


def test_the_relative_error_comes_from_femur_and_device() -> None:
    """Entry point and tip of the made-up runs are moved with them, by as much; the views have no part in it."""
    length, *axes = relative_origins(made_up(400))
    assert (length.response, [e.response for e in axes]) == ("length", ["along IS", "along LR", "along AP"])
    for explanation in axes:
        shares = {o.group: o.share for o in explanation.origins}
        assert shares["femur"] == pytest.approx(0.5, abs=0.1)
        assert shares["device"] == pytest.approx(0.5, abs=0.1)
        assert shares["C-arm views"] < 0.08
    assert {o.group for o in length.origins if o.share > 0.1} == {"femur", "device"}


def test_too_few_runs_for_a_regression_explain_nothing() -> None:
    assert relative_origins(made_up(20)) == []
    assert [e.response for e in relative_origins(made_up(40))] == ["length"]  # signed parts are more columns
