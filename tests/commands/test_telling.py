"""What commands tell while they work."""

from io import StringIO

import pytest
from rich.console import Console

from femoreg_torch.commands import telling


def test_a_log_is_told_every_half_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 10.0, 31.0, 31.0, 45.0, 62.0, 62.0])
    monkeypatch.setattr(telling.time, "monotonic", lambda: next(clock))
    log = StringIO()
    with telling.progress_report(Console(file=log), "draws") as report:
        for draw in range(1, 5):
            report(f"draw {draw} of 4", draw / 4)
    assert log.getvalue() == "50 %: draw 2 of 4\n100 %: draw 4 of 4\n"
