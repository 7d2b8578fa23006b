"""The deepest point of a notch in a plate, whose place is known."""

import numpy as np
import trimesh

from femoreg_torch.segment.rules import _sciatic_notch

STEP_MM = 0.25


def plate(back: float, up: float) -> trimesh.Trimesh:
    """A plate across the pelvis' left, 60 by 80 mm, with a notch from behind that ends at `back` and `up`, mm."""
    backs, ups = np.meshgrid(np.arange(-20, 40.01, STEP_MM), np.arange(-30, 50.01, STEP_MM), indexing="ij")
    vertices = np.stack([np.zeros_like(backs), backs, ups], -1).reshape(-1, 3)
    number = np.arange(backs.size).reshape(backs.shape)
    first, second, third, fourth = (
        n.ravel() for n in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
    )
    faces = np.concatenate([np.stack([first, second, third], 1), np.stack([first, third, fourth], 1)])
    middles = vertices[faces].mean(1)
    notch = np.abs(middles[:, 2] - up) < 0.7 * (middles[:, 1] - back)
    mesh = trimesh.Trimesh(vertices, faces[~notch], process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def test_the_end_of_a_notch_is_found_as_often_above_as_below_it() -> None:
    rng = np.random.default_rng(0)
    off = []
    for back, up in rng.uniform((25, 10), (27, 12), (20, 2)):
        found = _sciatic_notch(plate(back, up), np.eye(3), np.zeros(3), 0.4)
        assert found is not None
        off.append(found[1:] - (back, up))
    behind, above = np.mean(off, 0)
    assert abs(above) < 0.3
    assert 0 < behind < 1.5  # gaps of two pixels are closed, and with them the end of the notch
