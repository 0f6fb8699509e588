"""Runs an experiment: prepares datasets, fits them, and measures the fits. Writes table and figure after each run."""

import io
import json
import sys
import traceback
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from mi_ring.capture.loading import load_capture
from mi_ring.capture.reduction import WIDTH
from mi_ring.collection.fits import fit_to_the_end
from mi_ring.collection.jobs import Job, Record, modified
from mi_ring.errors import InputError
from mi_ring.experiments.experiment import NOT_RUN, Experiment, ExperimentOptions, Outcome, Row, Run
from mi_ring.experiments.measures import COURSE, POINTS, evaluated, surface_errors
from mi_ring.experiments.tables import csv_text, headings, markdown, table_of
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.light_selection import choose_lighting
from mi_ring.metrics.evaluation import rounded
from mi_ring.system.command import interrupted, one_line
from mi_ring.system.files import read_json, write_file
from mi_ring.system.machine import threads_of
from mi_ring.system.optional import installed
from mi_ring.system.progress import progress

NUMBERS = "numbers.json"  #: in the results folder of a run: the rows, and the files that they were measured from
RETRIES = 1  #: of a fit that is killed without making progress


def run_experiment(
    experiment: Experiment, options: ExperimentOptions, out: Path, only: Collection[str] = (), command_line: str = ""
) -> int:
    """Perform all runs of an experiment, or only those named in `only`. Returns the number of failed runs.

    If a run fails, the others continue. Results are written to `out`/runs/. After each run, table.csv, table.md and
    figure.png are written to `out`. A finished run is not repeated if its files and settings have not changed.
    `command_line`: text for table.md. Raises InputError before the first run if options are wrong.
    """
    runs = experiment.runs(options)
    if unknown := set(only) - {run.name for run in runs}:
        raise InputError(f"--only: has {min(unknown)}, must be of {', '.join(run.name for run in runs)}")
    for run in runs:
        run.config(options)
    outcomes = [Outcome(run) for run in runs]
    for k, run in enumerate(runs):
        wanted = not only or run.name in only
        if wanted:
            print(f"{k + 1} of {len(runs)}: {run.name}", flush=True)
        outcome = outcomes[k] = try_run(run, options, out, wanted)
        if outcome.failed not in ("", NOT_RUN):
            print(f"{run.name}: failed: {outcome.failed}", flush=True)
        if (wanted and not outcome.old) or k == len(runs) - 1:
            write_table_and_figure(experiment, outcomes, out, command_line)
    return sum(outcome.failed not in ("", NOT_RUN) for outcome in outcomes)


def try_run(run: Run, options: ExperimentOptions, out: Path, wanted: bool = True) -> Outcome:
    """Fit a run and measure the fit, which is written to `out`/runs/.

    Returns the numbers, or the reason why the run failed. `wanted`: False fits nothing, and only measures a fit that is
    there already.
    """
    try:
        if wanted:
            run.dataset.prepare()
        folder = out.resolve() / "runs" / run.name
        job = Job(run.dataset.scene.resolve(), folder, run.fit_options(options))
        fingerprint = job.fingerprint()
        done = job.is_done(fingerprint)
        if not done:
            if not wanted:
                return Outcome(run)
            print(f"fitting: {folder}", flush=True)
            job.save(replace(job.record, tries=0))  # interruptions by the user do not count as failures
            if run.watched:
                record = fit_and_watch(run, job, fingerprint, options)
            else:
                threads = ("--threads", str(options.threads)) if options.threads else ()
                record = fit_to_the_end(
                    job, fingerprint, RETRIES, threads, lambda line: print(f"  {line}", file=sys.stderr, flush=True)
                )
            if record.state != "done":
                return Outcome(run, failed=record.message)
        return Outcome(run, folder, measure_run(run, folder, options), "", done)
    except Exception as error:  # also errors of libraries: the other runs continue
        if interrupted():
            raise
        if not wanted:
            return Outcome(run)
        if not isinstance(error, InputError):
            traceback.print_exc(file=sys.stderr)
        return Outcome(run, failed=one_line(str(error)) or type(error).__name__)


def measure_run(run: Run, folder: Path, options: ExperimentOptions) -> list[Row]:
    """Measure a finished fit. Returns its rows of the table, and saves them in `folder`, the results folder of the fit.

    If the files have not changed since the last time, the saved rows are returned.
    """
    measure = run.measure or evaluated
    of = {"measure": measure.__name__, "spp": options.spp, "written": modified(folder / "ring.pt"),
          "compared": [[str(file.resolve()), modified(file)] for file in run.dataset.truth_files],
          "exactly": installed("igl")}  # fmt: skip
    before = read_json(folder / NUMBERS)
    if not (isinstance(before, dict) and before.get("of") == of):
        before = {"of": of, "rows": rounded(measure(run, folder, options))}
        write_file(folder / NUMBERS, json.dumps(before, indent=1))
    return before["rows"]


def fit_and_watch(run: Run, job: Job, fingerprint: str, options: ExperimentOptions) -> Record:
    """Fit a run in this process. Errors of normals and depth are measured several times during the fit.

    They are written to course.json in the results folder. `fingerprint`: hash of the job's input. Returns the record of
    the finished fit.
    """
    rows: list[Row] = []

    def measure(it: Iteration) -> None:
        if it.number * POINTS // fit.iterations > len(rows):
            _, numbers = surface_errors(run, fit.capture, fit.ring, *fit.ring.domain.sample(fit.ring.subdivisions))
            rows.append({"iteration": it.number, "seconds": fit.course.seconds, **numbers})

    with threads_of(options.threads):
        config = run.config(options)
        width = max(WIDTH, *config.widths)
        capture = load_capture(run.dataset.scene, masks=config.masks, width=width, pairs=config.pairs)
        fit = Fit(capture, config, callbacks=[measure], lighting=choose_lighting(capture, config))
        for _ in progress(fit, "iterations", total=fit.iterations):
            pass
        fit.save(job.folder)
    write_file(job.folder / COURSE, json.dumps(rows))
    ring = modified(job.folder / "ring.pt")
    return job.save(replace(job.record, state="done", done=fingerprint, written=ring))


def write_table_and_figure(experiment: Experiment, outcomes: list[Outcome], out: Path, command_line: str) -> None:
    """Write table.csv, table.md and figure.png to the folder `out`.

    `outcomes`: of all runs, also those that are not done. `command_line`: text for table.md. If no run is finished, or
    if drawing fails, figure.png is removed.
    """
    rows = table_of(experiment, outcomes)
    names = headings(experiment, outcomes, rows)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "table.csv", csv_text(names, rows))
    write_file(out / "table.md", markdown(experiment, names, rows, command_line))
    file, buffer, content = out / "figure.png", io.BytesIO(), b""
    if not all(outcome.failed for outcome in outcomes):
        try:
            figure = experiment.figure([outcome for outcome in outcomes if outcome.failed != NOT_RUN])
            figure.savefig(buffer, format="png", dpi=120)
            content = buffer.getvalue()
        except Exception as error:  # the results of one run may be damaged: the other runs continue
            if interrupted():
                raise
            print(f"{file}: cannot be drawn: {one_line(str(error)) or type(error).__name__}", flush=True)
    if content:
        write_file(file, content)
    else:
        file.unlink(missing_ok=True)  # it shows other runs
