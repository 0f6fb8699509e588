"""Jobs: scenes to fit. A record beside the results gives the state of each fit."""

import contextlib
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from mi_ring.errors import InputError, require_file
from mi_ring.output.results import read_log
from mi_ring.system.command import scene_name
from mi_ring.system.files import quoted, read_json, write_file

RECORDS = "batch"  #: folder beside the results: the record and the printed output of each fit
CHECKPOINTS = "checkpoint.pt", "checkpoint.before.pt"


@dataclass(frozen=True)
class Record:
    """The state of the fit of a job, as a file beside the results stores it."""

    state: str = "waiting"  #: waiting, running, interrupted, failed or done
    fingerprint: str = ""  #: of the job that is being fitted
    message: str = ""  #: why the fit failed
    tries: int = 0  #: starts since the fit last made progress
    iteration: int = 0  #: at the start of the last try
    since: float = 0.0  #: time of the first start for this fingerprint; older files in the folder are of other fits
    done: str = ""  #: fingerprint of the results in the folder; a later failed fit keeps them
    written: int = 0  #: modification time of their ring.pt [ns]


@dataclass(frozen=True)
class Job:
    """A scene to fit, the folder of its results, and options of `mi-ring fit`. Scene and folder are absolute paths."""

    scene: Path
    folder: Path
    options: tuple[str, ...] = ()
    cwd: Path = Path()  #: paths in `options` are relative to this folder

    @property
    def name(self) -> str:
        """Name of the results folder."""
        return self.folder.name

    @property
    def output(self) -> Path:
        """File that receives the printed output of the fit."""
        return self.folder.parent / RECORDS / f"{self.name}.txt"

    @property
    def record(self) -> Record:
        """The last saved record. If there is none, or if it is damaged: a new record with the state "waiting"."""
        with contextlib.suppress(TypeError):
            return Record(**read_json(self.output.with_suffix(".json")))
        return Record()

    def save(self, record: Record) -> Record:
        """Write a record to its file, and return it."""
        path = self.output.with_suffix(".json")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps(asdict(record)))
        return record

    def fingerprint(self) -> str:
        """Return a hash of the input: the options, the scene file, and all files that these two name."""
        result = hashlib.blake2b(repr(self.options).encode(), digest_size=16)
        with contextlib.suppress(OSError):  # the fit reports what is wrong with the scene file
            text = self.scene.read_bytes()
            result.update(text)
            named = {self.scene.parent / word for word in quoted(text)}
            given = (self.cwd / (option.partition("=")[2] or option) for option in self.options)
            for file in sorted({*named, *given}):
                with contextlib.suppress(OSError):
                    if file.is_file():
                        result.update(str(file.name).encode() + hashlib.blake2b(file.read_bytes()).digest())
        return result.hexdigest()

    def has_checkpoint(self, since: float) -> bool:
        """Test whether a checkpoint was written at the time `since` [s, Unix time] or later."""
        return any(modified(self.folder / name) / 1e9 >= since for name in CHECKPOINTS)

    def iteration(self, since: float = 0.0) -> int:
        """Return the last iteration in log.jsonl.

        Returns 0 if the log is missing, or if it was last written before the time `since` [s, Unix time].
        """
        with contextlib.suppress(OSError, KeyError, TypeError):
            if modified(self.folder / "log.jsonl") / 1e9 >= since:
                return int(max((entry["iteration"] for entry in read_log(self.folder)), default=0))
        return 0

    @property
    def progress(self) -> str:
        """Progress of a running fit as text, for example "iteration 20 of 100"."""
        planned = ""
        with contextlib.suppress(OSError, IndexError):
            planned = re.findall(r"iteration \d+/(\d+)", self.output.read_text(errors="replace"))[-1]
        iteration = self.iteration(self.record.since)
        return f"iteration {iteration}{' of ' * bool(planned)}{planned}" if iteration else "begins"

    def is_done(self, fingerprint: str) -> bool:
        """Test whether the results folder has complete results of the input with this hash, `fingerprint`."""
        record, ring = self.record, modified(self.folder / "ring.pt")
        there = ring and (self.folder / "report.html").is_file()
        return bool(there) and (record.done, record.written) == (fingerprint, ring)


def modified(path: Path) -> int:
    """Return the modification time of a file [ns]. Returns 0 if there is no such file."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def make_jobs(scenes: Sequence[Path], out: Path, options: Sequence[str]) -> list[Job]:
    """Make a job for each scene. `out`: folder for all results. `options`: command-line options of each fit.

    Raises InputError if a scene file is missing, if two jobs would have the same results folder, or if a scene file is
    inside its results folder.
    """
    jobs: dict[str, Job] = {}
    for scene in scenes:
        require_file(scene, "the XML file of a scene")
        name = scene_name(scene)
        if name in jobs and jobs[name].scene == scene.resolve():
            raise InputError(f"{scene}: is given twice; give it once")
        if name in jobs or name == RECORDS:
            other = f"those of {jobs[name].scene}" if name in jobs else "the records of the batch"
            raise InputError(f"{scene}: its results would go to {out / name}, as do {other}; rename it, or "
                             "fit it in another batch with another --out")  # fmt: skip
        folder = out.resolve() / name
        if folder in scene.resolve().parents:
            raise InputError(f"{folder}: --out: holds the scene file {scene.name} itself; choose another folder")
        jobs[name] = Job(scene.resolve(), folder, tuple(options), Path.cwd())
    return list(jobs.values())
