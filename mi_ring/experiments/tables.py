"""Tables of experiments: ours beside what was published, as CSV and Markdown."""

import csv
import datetime
import io
from collections.abc import Mapping, Sequence
from typing import Any

from mi_ring.experiments.experiment import NOT_RUN, Experiment, Outcome, Row
from mi_ring.system.machine import computer

OURS = "ours"  #: who says so


def table_of(experiment: Experiment, outcomes: Sequence[Outcome]) -> list[Row]:
    """Rows: ours, the means of ours, and each published one after those of ours that it has all labels of.

    Of each row `by` says whose it is and `state` what became of its run, if it has no numbers: none is left out.
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
    """Of runs that differ in their seed alone, a row with the mean of each number, over those that are done.

    And of those that differ in seed and `mean_over`, where that is another label.

    A number that only some of them have is left out: its mean would be of others than the row says.
    """
    result = []
    for over in dict.fromkeys(("seed", experiment.mean_over)):
        groups = dict[tuple, list[Outcome]]()
        for outcome in outcomes:
            if over in outcome.run.labels:
                key = tuple(
                    (label, value) for label, value in outcome.run.labels.items() if label not in (over, "seed")
                )
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
    """Of the columns: labels, whose figures, the numbers that any row has, and what became of runs if one has none."""
    labels = [label for labelled in (*(o.run.labels for o in outcomes), *experiment.published) for label in labelled]
    own = {label: label for label in labels if label not in experiment.columns and label != "by"}
    numbers = {name: column.heading for name, column in experiment.columns.items() if any(name in row for row in rows)}
    return {**own, "by": "by", **numbers, **({"state": "state"} if any(row["state"] for row in rows) else {})}


def cell(experiment: Experiment, name: str, value: Any) -> str:
    """A number with as many digits as its column has; NaN and infinity as they are."""
    if isinstance(value, float) and name in experiment.columns:
        return f"{value:.{experiment.columns[name].digits}f}"
    return str(value).replace("|", "/")


def csv_text(names: Mapping[str, str], rows: Sequence[Row]) -> str:
    """All that is shown, with all digits; `names` are those of `headings`."""
    box = io.StringIO()
    writer = csv.DictWriter(box, list(names), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return box.getvalue()


def markdown(experiment: Experiment, names: Mapping[str, str], rows: Sequence[Row], said: str) -> str:
    """The table, what it is of, and how it was made."""
    lines = [list(names.values()), ["---"] * len(names)]
    lines += [[cell(experiment, name, row.get(name, "")) for name in names] for row in rows]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{experiment.about}\n\n{table}\n\n{said}; {computer()}; {datetime.date.today()}\n"
