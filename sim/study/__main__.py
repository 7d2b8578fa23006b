"""`python -m sim.study COMMAND …`: measures what `docs/accuracy.md` and `docs/planning.md` tell; see the Makefile."""

import sys
from collections.abc import Sequence
from typing import Any

from jsonargparse import auto_cli

from femoreg_torch.commands.status import BAD_INPUT, DONE
from femoreg_torch.errors import InputError
from sim.study.accuracy_commands import ablation, accuracy, cases, conditions, listing
from sim.study.cadaver import cadaver
from sim.study.limit_commands import limits
from sim.study.plan_commands import plans
from sim.study.start_commands import capture_range, trust


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; bad input is told in one line, with exit status 2."""
    commands: dict[str, Any] = {
        "accuracy": accuracy,
        "cases": cases,
        "capture-range": capture_range,
        "trust": trust,
        "ablation": ablation,
        "conditions": conditions,
        "limits": limits,
        "cadaver": cadaver,
        "plans": plans,
        "list": listing,
    }
    try:
        status = auto_cli(commands, args=None if arguments is None else list(arguments), as_positional=False)
    except InputError as error:
        print(f"sim.study: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    return int(status or DONE)


if __name__ == "__main__":
    sys.exit(main())
