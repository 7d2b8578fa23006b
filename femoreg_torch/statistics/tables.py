"""All tables of a group of runs, and the overview of a study."""

import pandas as pd

from femoreg_torch.statistics.cause_tables import dependence_table, origin_table
from femoreg_torch.statistics.cells import about_failures, error_numbers
from femoreg_torch.statistics.course_tables import cost_table, round_table
from femoreg_torch.statistics.error_tables import error_table, metric_table, pose_table
from femoreg_torch.statistics.formats import PAPER, Table, number, percent, plus_minus
from femoreg_torch.statistics.outcome import WRONG_MM
from femoreg_torch.statistics.quantities import RELATIVE
from femoreg_torch.statistics.rows import DONE, FAILED, REFUSED, groups
from femoreg_torch.statistics.summary import confusion, statistics, trusted_runs, within
from femoreg_torch.statistics.trust_tables import coverage_table, success_table, trust_table


def group_tables(rows: pd.DataFrame, seed: int) -> list[Table]:
    """All tables of one group of runs; `seed` is that of the bootstrap."""
    tables = [
        pose_table(rows),
        metric_table(rows),
        error_table(rows, seed),
        success_table(rows),
        trust_table(rows),
        coverage_table(rows),
        round_table(rows, seed),
        dependence_table(rows),
        origin_table(rows),
        cost_table(rows),
    ]
    return [table for table in tables if table.rows]


def overview_table(rows: pd.DataFrame) -> Table:
    """A row for every condition, and one for all."""
    lines, data = [], []
    for name, part in groups(rows).items():
        counts = {status: int(part["status"].eq(status).sum()) for status in (DONE, REFUSED, FAILED)}
        s, trusted = statistics(part, RELATIVE.column), trusted_runs(part)
        right = within(part, RELATIVE.column, WRONG_MM)
        whole = confusion(part)
        assert whole is not None  # of whole runs there always is one
        lines.append(
            (
                name,
                str(len(part)),
                *(str(counts[status]) for status in (REFUSED, FAILED)),
                percent(trusted.share),
                str(whole.wrong_trusted),
                plus_minus(s.mean, s.deviation, 2),
                number(s.median, 2),
                percent(right.share),
            )
        )
        data.append(
            {
                "condition": name,
                "runs": len(part),
                **counts,
                "trusted": trusted.met,
                "wrong_trusted": whole.wrong_trusted,
            }
            | {key: value for key, value in error_numbers(RELATIVE, s).items() if not key.startswith(PAPER)}
            | {"success": right.met}
        )
    columns = (
        "condition", "runs", "refused", "failed", "trusted", "wrong, trusted", "mean ± SD, mm", "median, mm",
        f"≤ {WRONG_MM:g} mm",
    )  # fmt: skip
    return Table(
        "overview", f"The study, error {RELATIVE.name}", about_failures(), columns, tuple(lines), pd.DataFrame(data)
    )
