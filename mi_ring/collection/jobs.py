"""A scene to be fitted among many, and how far its fit is, as files beside the results tell."""

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

RECORDS = "batch"  #: folder beside the results with a record of each fit and with what it has printed
CHECKPOINTS = "checkpoint.pt", "checkpoint.before.pt"


@dataclass(frozen=True)
class Record:
    """How far the fit of a scene is."""

    state: str = "waiting"  #: waiting, running, interrupted, failed or done
    fingerprint: str = ""  #: of what it is the fit of
    message: str = ""  #: why it failed
    tries: int = 0  #: how often it was begun since it got any further
    iteration: int = 0  #: at the beginning of the last try
    since: float = 0.0  #: when the fit of this fingerprint was begun first; what is older in the folder is another's
    done: str = ""  #: fingerprint of the results that were there last, which another fit that fails leaves there
    written: int = 0  #: when their ring.pt was, in nanoseconds


@dataclass(frozen=True)
class Job:
    """A scene, the folder of its results, and options of `mi_ring.fit`; the first two paths are absolute."""

    scene: Path
    folder: Path
    options: tuple[str, ...] = ()
    place: Path = Path()  #: the folder that paths in `options` are relative to

    @property
    def name(self) -> str:
        """Of the results."""
        return self.folder.name

    @property
    def output(self) -> Path:
        """The file with what its fit has printed."""
        return self.folder.parent / RECORDS / f"{self.name}.txt"

    @property
    def record(self) -> Record:
        """What was written last; that of a fit that waits, if it cannot be read."""
        with contextlib.suppress(TypeError):
            return Record(**read_json(self.output.with_suffix(".json")))
        return Record()

    def note(self, record: Record) -> Record:
        """Write a record, and return it."""
        path = self.output.with_suffix(".json")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps(asdict(record)))
        return record

    def fingerprint(self) -> str:
        """Of the options, of the scene file, and of all files that one of either names."""
        result = hashlib.blake2b(repr(self.options).encode(), digest_size=16)
        with contextlib.suppress(OSError):  # the fit says what is wrong with it
            text = self.scene.read_bytes()
            result.update(text)
            named = {self.scene.parent / word for word in quoted(text)}
            given = (self.place / (option.partition("=")[2] or option) for option in self.options)
            for file in sorted({*named, *given}):
                with contextlib.suppress(OSError):
                    if file.is_file():
                        result.update(str(file.name).encode() + hashlib.blake2b(file.read_bytes()).digest())
        return result.hexdigest()

    def has_checkpoint(self, since: float) -> bool:
        """Can its fit, begun at a time `since`, go on from one?"""
        return any(written(self.folder / name) / 1e9 >= since for name in CHECKPOINTS)

    def iteration(self, since: float = 0.0) -> int:
        """The last that its log has; 0 if there is none of a fit begun at a time `since`."""
        with contextlib.suppress(OSError, KeyError, TypeError):
            if written(self.folder / "log.jsonl") / 1e9 >= since:
                return int(max((entry["iteration"] for entry in read_log(self.folder)), default=0))
        return 0

    @property
    def progress(self) -> str:
        """How far a fit that is running is, in words."""
        planned = ""
        with contextlib.suppress(OSError):
            said = re.findall(r"iteration \d+/(\d+)", self.output.read_text(errors="replace"))
            planned = f" of {said[-1]}" if said else ""
        iteration = self.iteration(self.record.since)
        return f"iteration {iteration}{planned}" if iteration else "begins"

    def is_done(self, fingerprint: str) -> bool:
        """Are there results, of what the scene and its options still are?"""
        record, ring = self.record, written(self.folder / "ring.pt")
        there = ring and (self.folder / "report.html").is_file()
        return bool(there) and (record.done, record.written) == (fingerprint, ring)


def written(path: Path) -> int:
    """When a file was, in nanoseconds; 0 if there is none."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def jobs_of(scenes: Sequence[Path], out: Path, options: Sequence[str]) -> list[Job]:
    """A job for each scene.

    Raises InputError if one is no file, if two have the same name, or if results would go onto a scene.
    """
    jobs: dict[str, Job] = {}
    for scene in scenes:
        require_file(scene, "the XML file of a scene")
        name = scene_name(scene)
        if name in jobs and jobs[name].scene == scene.resolve():
            raise InputError(f"{scene}: is given twice; give it once")
        if name in jobs or name == RECORDS:
            other = f"{jobs[name].scene} is" if name in jobs else "records of batches are"
            raise InputError(f"{scene}: its results would go to {out / name}, where {other} to be; rename it, or "
                             "fit it in a batch of its own with another --out")  # fmt: skip
        folder = out.resolve() / name
        if folder in scene.resolve().parents:
            raise InputError(f"{folder}: --out: holds the scene file {scene.name} itself; choose another folder")
        jobs[name] = Job(scene.resolve(), folder, tuple(options), Path.cwd())
    return list(jobs.values())
