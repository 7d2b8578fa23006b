"""Work shared out among the cores comes back as if one had done it all."""

import threading

import numba
import pytest
import torch
from registration_scenes import make_scene, true_poses
from torch import Tensor

from femoreg_torch.cores import on_all_cores, shares
from femoreg_torch.registration import Level
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.scene import Body, reference_point_in_view
from femoreg_torch.similarity import GradNcc


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if numba had two threads here, and one in each thread of the pool, however many there are."""
    here = threading.current_thread()
    numba.get_num_threads()  # or nobody has chosen numba's layer
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2 if threading.current_thread() is here else 1)


def test_items_come_back_in_order_and_several_are_worked_on_at_a_time(two_cores: None) -> None:
    both_there = threading.Barrier(2, timeout=30)

    def waits_for_another(item: int) -> int:
        both_there.wait()
        return item**2

    assert on_all_cores(waits_for_another, range(8)) == [item**2 for item in range(8)]


def test_each_thread_uses_one_core_and_shares_nothing_out_itself(two_cores: None) -> None:
    before = torch.get_num_threads()

    def within(_: int) -> tuple[int, set[str]]:
        names = on_all_cores(lambda _: threading.current_thread().name, range(4))
        return torch.get_num_threads(), {*names, threading.current_thread().name}

    for threads, names in on_all_cores(within, range(4)):
        assert threads == 1
        assert len(names) == 1
    assert torch.get_num_threads() == before
    later: list[int] = []
    thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert later == [before]


def test_what_lies_on_a_gpu_stays_in_one_thread(two_cores: None) -> None:
    used = on_all_cores(lambda _: threading.current_thread(), range(4), torch.device("cuda"))
    assert set(used) == {threading.current_thread()}
    assert shares(100, torch.device("cuda")) == [slice(0, 100)]


def test_the_first_failure_is_told(two_cores: None) -> None:
    with pytest.raises(ZeroDivisionError):
        on_all_cores(lambda item: 1 / item, [1, 0, 2, 3])


@pytest.mark.parametrize("count", [0, 1, 2, 5, 250])
def test_shares_hold_all_of_a_batch_in_order(count: int, two_cores: None) -> None:
    assert [n for share in shares(count) for n in range(count)[share]] == list(range(count))


def test_costs_and_derivatives_do_not_depend_on_the_cores(two_cores: None, monkeypatch: pytest.MonkeyPatch) -> None:
    truth, level = true_poses(), Level(pixel_mm=3.0, step_mm=3.0)
    scene = make_scene(truth)
    scale = torch.tensor([0.03, 0.03, 0.03, 2.0, 2.0, 6.0], dtype=torch.float64)
    bodies = tuple(Body((name,), 0, reference_point_in_view(scene, truth, name, 0), scale) for name in scene.objects)
    images = scene.there(scene.images, range(scene.views))
    deltas = 0.3 * torch.randn(5, 18, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def found() -> list[Tensor]:
        costs = image_costs(
            scene, truth, bodies, list(scene.objects), images, level, GradNcc(4), imaging=Imaging(scatter=0.3)
        )
        models = costs.quadratics(deltas[0])
        return [costs(deltas), *(part for model in models for part in (model.scores, model.hessian))]

    shared = found()
    monkeypatch.setattr(numba, "get_num_threads", lambda: 1)
    for one, other in zip(shared, found(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-7)
    assert (
        len({float(cost) for cost in shared[0].flatten()}) == shared[0].numel()
    )  # no image or delta taken for another
