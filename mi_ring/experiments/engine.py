"""Performs an experiment: makes what it needs, fits, measures, writes table and figure after each run."""

import io
import json
import sys
import traceback
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mi_ring.capture.loading import load_capture
from mi_ring.collection.fits import fit_to_the_end
from mi_ring.collection.jobs import Job, Record, written
from mi_ring.errors import InputError
from mi_ring.experiments.experiment import NOT_RUN, Asked, Experiment, Made, Outcome, Row, Run, require_distinct
from mi_ring.experiments.measures import COURSE, POINTS, evaluated
from mi_ring.experiments.tables import csv_text, headings, markdown, table_of
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.light_selection import choose_lighting
from mi_ring.metrics.evaluation import rounded
from mi_ring.metrics.surfaces import compare_surfaces, load_true_mesh
from mi_ring.scene.plain_mesh import scene_of
from mi_ring.system.command import interrupted, one_line
from mi_ring.system.files import read_json, write_file
from mi_ring.system.machine import threads_of
from mi_ring.system.optional import installed
from mi_ring.system.progress import progress

NUMBERS = "numbers.json"  #: of a run, in the folder of its results: what was measured of which fit
RETRIES = 1  #: of a fit that is killed without getting any further


def perform(experiment: Experiment, asked: Asked, out: Path, only: Collection[str] = (), said: str = "") -> int:
    """Make, measure and show all runs, or `only` some, in out/runs/; returns how many failed.

    A run that fails does not stop the others; table.csv, table.md and figure.png are there after each that is new. What
    is done already, of the same files and settings, is not made again. `said`: how it was called, for the table.

    Raises InputError for what is wrong with all of it, before any work.
    """
    runs = experiment.runs(asked)
    require_distinct(runs)
    if unknown := set(only) - {run.name for run in runs}:
        raise InputError(f"--only: has {min(unknown)}, must be of {', '.join(run.name for run in runs)}")
    for run in runs:
        run.config(asked)
    outcomes = [Outcome(run) for run in runs]
    for k, run in enumerate(runs):
        wanted = not only or run.name in only
        if wanted:
            print(f"{k + 1} of {len(runs)}: {run.name}", flush=True)
        outcomes[k] = attempted(run, asked, out, wanted)
        if outcomes[k].failed not in ("", NOT_RUN):
            print(f"{run.name}: failed: {outcomes[k].failed}", flush=True)
        if (wanted and not outcomes[k].old) or k == len(runs) - 1:
            show(experiment, outcomes, out, said)
    return sum(outcome.failed not in ("", NOT_RUN) for outcome in outcomes)


def attempted(run: Run, asked: Asked, out: Path, wanted: bool = True) -> Outcome:
    """Make and measure one run; one that is not `wanted` only if its fit is there. Whatever goes wrong is its own."""
    try:
        captures, folder = out.parent / "captures" / asked.size, out.resolve() / "runs" / run.name
        scene = run.recipe.made(captures) if wanted else run.recipe.place(captures)
        made = Made(folder, scene, run.recipe.truth(captures), captures, asked)
        job = Job(scene.resolve(), folder, run.options(asked))
        fingerprint = job.fingerprint()
        done = job.is_done(fingerprint)
        if not done:
            if not wanted:
                return Outcome(run)
            print(f"fitting: {folder}", flush=True)
            job.note(replace(job.record, tries=0))  # interrupts of the user's are no deaths
            record = (
                watched(run, job, fingerprint, made)
                if run.watched
                else fit_to_the_end(job, fingerprint, RETRIES, threads(asked), tell)
            )
            if record.state != "done":
                return Outcome(run, failed=record.message)
        return Outcome(run, made, measured(run, made), "", done)
    except Exception as error:  # of libraries, too: the other runs are worth more
        if interrupted():
            raise
        if not wanted:
            return Outcome(run)
        if not isinstance(error, InputError):
            traceback.print_exc(file=sys.stderr)
        return Outcome(run, failed=reason(error))


def reason(error: Exception) -> str:
    """What has gone wrong, in one line, as tables need it."""
    return one_line(str(error)) or type(error).__name__


def tell(line: str) -> None:
    """What a fit says, where progress is said."""
    print(f"  {line}", file=sys.stderr, flush=True)


def threads(asked: Asked) -> tuple[str, ...]:
    """As an option of fits, whose results it does not change."""
    return ("--threads", str(asked.threads)) if asked.threads else ()


def measured(run: Run, made: Made) -> list[Row]:
    """The rows of a finished fit; those of before if it is the same."""
    measure: Callable[[Run, Made], list[Row]] = run.measure or evaluated
    of = {"measure": measure.__name__, "spp": made.asked.spp, "written": written(made.folder / "ring.pt"),
          "compared": [[str(file.resolve()), written(file)] for file in run.recipe.compared(made.captures)],
          "exactly": installed("igl")}  # fmt: skip
    before = read_json(made.folder / NUMBERS)
    if not (isinstance(before, dict) and before.get("of") == of):
        before = {"of": of, "rows": rounded(measure(run, made))}
        write_file(made.folder / NUMBERS, json.dumps(before, indent=1))
    return before["rows"]


def watched(run: Run, job: Job, fingerprint: str, made: Made) -> Record:
    """Fit in this process, and write what the errors of normals and depth were in its course."""
    mesh, truth = load_true_mesh(made.truth / "mesh.ply")
    rows: list[Row] = []

    def look(it: Iteration) -> None:
        if it.number * POINTS // fit.iterations > len(rows):
            s, faces = fit.ring.domain.sample(fit.ring.subdivisions)
            with torch.no_grad():
                vertices = fit.ring.surface(s.to(fit.problem.device)).cpu().numpy()
            diagonal = float(np.linalg.norm(mesh.extents))
            numbers, _ = compare_surfaces(fit.capture, scene_of(vertices, faces), truth, diagonal)
            rows.append({"iteration": it.number, "seconds": fit.course.seconds, **numbers})

    with threads_of(made.asked.threads):
        config = run.config(made.asked)
        capture = load_capture(made.scene, masks=config.masks)
        fit = Fit(capture, config, callbacks=[look], lighting=choose_lighting(capture, config))
        for _ in progress(fit, "iterations", total=fit.iterations):
            pass
        fit.save(job.folder)
    write_file(job.folder / COURSE, json.dumps(rows))
    ring = written(job.folder / "ring.pt")
    return job.note(replace(job.record, state="done", done=fingerprint, written=ring))


def show(experiment: Experiment, outcomes: list[Outcome], out: Path, said: str) -> None:
    """Write table.csv, table.md and, unless it cannot be drawn, figure.png of what there is."""
    rows = table_of(experiment, outcomes)
    names = headings(experiment, outcomes, rows)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "table.csv", csv_text(names, rows))
    write_file(out / "table.md", markdown(experiment, names, rows, said))
    if picture := drawn(experiment, outcomes, out / "figure.png"):
        write_file(out / "figure.png", picture)
    else:
        (out / "figure.png").unlink(missing_ok=True)  # of other runs


def drawn(experiment: Experiment, outcomes: list[Outcome], file: Path) -> bytes:
    """The figure as a PNG; nothing if no run is done, or if it cannot be drawn, which is said."""
    if all(outcome.failed for outcome in outcomes):
        return b""
    ran, buffer = [outcome for outcome in outcomes if outcome.failed != NOT_RUN], io.BytesIO()
    try:
        experiment.figure(ran).savefig(buffer, format="png", dpi=120)
    except Exception as error:  # of one run's results, for instance: the other runs are worth more
        if interrupted():
            raise
        print(f"{file}: cannot be drawn: {reason(error)}", flush=True)
        return b""
    return buffer.getvalue()
