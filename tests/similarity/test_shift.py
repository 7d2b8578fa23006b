"""Where a shifted image is found by the correlation of gradients."""

import pytest
import torch
from torch import Tensor

from femoreg_torch.similarity import even_gradients, shift_correlation

HIDDEN = torch.zeros(48, 60, dtype=torch.bool)
HIDDEN[:, :14] = True


def smooth(seed: int, rows: int, columns: int) -> Tensor:
    noise = torch.randn(1, 1, rows + 10, columns + 10, generator=torch.Generator().manual_seed(seed))
    for _ in range(2):
        noise = torch.nn.functional.avg_pool2d(noise, 5, 1, 1)
    return noise[0, 0, 3:-3, 3:-3]


@pytest.mark.parametrize(("rows", "columns"), [(0, 0), (5, -8), (-6, 3)])
@pytest.mark.parametrize("shaded", [False, True])
def test_a_shifted_image_is_found_where_it_was_shifted_to(rows: int, columns: int, shaded: bool) -> None:
    large = smooth(0, 68, 80)
    moving = large[10:58, 10:70]
    fixed = large[10 - rows : 58 - rows, 10 - columns : 70 - columns].clone()
    field = None
    if shaded:  # what is hidden is something else, and does not count
        fixed[HIDDEN] = 5 * torch.randn(int(HIDDEN.sum()), generator=torch.Generator().manual_seed(1))
        field = ~torch.nn.functional.max_pool2d(HIDDEN[None].float(), 7, 1, 3)[0].bool()
    found = shift_correlation(even_gradients(torch.stack([smooth(2, 48, 60), moving])), fixed, field, (8, 10))
    assert found.shape == (2, 17, 21)
    assert divmod(int(found[1].argmax()), 21) == (8 + rows, 10 + columns)
    assert found[1].max() > 0.55
    assert found[0].max() < 0.5 * found[1].max()
