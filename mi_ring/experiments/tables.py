"""Tables of our results and of published ones, as CSV and Markdown."""

import csv
import datetime
import io
from collections.abc import Mapping, Sequence
from typing import Any

from mi_ring.experiments.experiment import NOT_RUN, Experiment, Outcome, Row
from mi_ring.system.machine import computer

OURS = "ours"  #: value of the column `by`


def table_of(experiment: Experiment, outcomes: Sequence[Outcome]) -> list[Row]:
    """Return the rows of the table: a row for each row of our results, then means, and published rows.

    A published row is placed below our rows with the same labels. If a run has no numbers, its entry `state` says why.
    """
    rows: list[Row] = []
    for outcome in outcomes:
        state = f"failed: {outcome.failed}" if outcome.failed not in ("", NOT_RUN) else outcome.failed
        rows += [{**outcome.run.labels, "by": OURS, "state": state, **row} for row in outcome.rows or [{}]]
    rows += means(experiment, outcomes)
    for row in experiment.published:
        labels = row.keys() - experiment.columns.keys() - {"by"}
        alike = [k for k, other in enumerate(rows) if all(other.get(label) == row[label] for label in labels)]
        rows.insert(alike[-1] + 1 if alike else len(rows), {"state": "", **row})
    return rows


def means(experiment: Experiment, outcomes: Sequence[Outcome]) -> list[Row]:
    """Return rows of means, over seeds and over the values of the label `mean_over` of the experiment.

    Only finished runs count. A mean is given only for numbers that all rows have.
    """
    result = []
    for over in dict.fromkeys(("seed", experiment.mean_over)):
        groups = dict[tuple, list[Outcome]]()
        for outcome in outcomes:
            if over in outcome.run.labels:
                key = tuple(item for item in outcome.run.labels.items() if item[0] not in (over, "seed"))
                groups.setdefault(key, []).append(outcome)
        for key, group in groups.items():
            rows = [row for outcome in group for row in outcome.rows]
            if len(group) > 1 and rows:
                count = f"mean of {len(rows)}" + f" of {len(group)}" * (len(rows) < len(group))
                shared = [name for name in experiment.columns if all(name in row for row in rows)]
                mean = {name: sum(row[name] for row in rows) / len(rows) for name in shared}
                result.append({**dict(key), over: count, "by": OURS, "state": "", **mean})
    return result


def headings(experiment: Experiment, outcomes: Sequence[Outcome], rows: Sequence[Row]) -> dict[str, str]:
    """Return a dict from the names of the table's columns to their headings. Columns without content are left out.

    The order is: labels of runs, `by` (whose numbers they are), numbers, `state`.
    """
    labels = [label for labelled in (*(o.run.labels for o in outcomes), *experiment.published) for label in labelled]
    own = {label: label for label in labels if label not in experiment.columns and label != "by"}
    numbers = {name: column.heading for name, column in experiment.columns.items() if any(name in row for row in rows)}
    return {**own, "by": "by", **numbers, **({"state": "state"} if any(row["state"] for row in rows) else {})}


def csv_text(names: Mapping[str, str], rows: Sequence[Row]) -> str:
    """Return the table as CSV, with all digits of the numbers.

    `names`: a dict from the names of columns to their headings.
    """
    box = io.StringIO()
    writer = csv.DictWriter(box, list(names), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return box.getvalue()


def markdown(experiment: Experiment, names: Mapping[str, str], rows: Sequence[Row], command_line: str) -> str:
    """Return the table as Markdown.

    Above it is the subject of the experiment, below it command line, computer and date. `names`: a dict from the names
    of columns to their headings.
    """

    def cell(name: str, value: Any) -> str:
        if isinstance(value, float) and name in experiment.columns:
            return f"{value:.{experiment.columns[name].digits}f}"
        return str(value).replace("|", "/")

    lines = [list(names.values()), ["---"] * len(names)]
    lines += [[cell(name, row.get(name, "")) for name in names] for row in rows]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{experiment.about}\n\n{table}\n\n{command_line}; {computer()}; {datetime.date.today()}\n"
