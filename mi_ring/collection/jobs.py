"""A scene to be fitted among many, and how far its fit is, as files beside the results tell."""

import contextlib
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from mi_ring.errors import InputError
from mi_ring.output.results import read_log
from mi_ring.system.command import scene_name
from mi_ring.system.files import read_json, write_file

RECORDS = "batch"  #: folder beside the results with a record of each fit and with what it has printed
CHECKPOINTS = "checkpoint.pt", "checkpoint.before.pt"


@dataclass(frozen=True)
class Record:
    """How far the fit of a scene is."""

    state: str = "waiting"  #: waiting, running, failed or done
    fingerprint: str = ""  #: of what it is the fit of
    message: str = ""  #: why it failed
    tries: int = 0  #: how often it was begun since it got any further
    iteration: int = 0  #: at the beginning of the last try


@dataclass(frozen=True)
class Job:
    """A scene, the folder of its results, and options of `mi_ring.fit`; paths are absolute."""

    scene: Path
    folder: Path
    options: tuple[str, ...] = ()

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
            words = re.findall(rb"\"([^\"<>\0\n]{1,500})\"|'([^'<>\0\n]{1,500})'", text)
            named = {self.scene.parent / (a or b).decode(errors="replace") for a, b in words}
            given = (Path(option.partition("=")[2] or option) for option in self.options)
            for file in sorted({*named, *given}):
                with contextlib.suppress(OSError):
                    if file.is_file():
                        result.update(str(file.name).encode() + hashlib.blake2b(file.read_bytes()).digest())
        return result.hexdigest()

    @property
    def has_checkpoint(self) -> bool:
        """Can its fit go on from one?"""
        return any((self.folder / name).is_file() for name in CHECKPOINTS)

    @property
    def iteration(self) -> int:
        """The last that its log has; 0 if there is none."""
        with contextlib.suppress(OSError, KeyError, TypeError):
            return int(max((entry["iteration"] for entry in read_log(self.folder)), default=0))
        return 0

    @property
    def progress(self) -> str:
        """How far a fit that is running is, in words."""
        planned = ""
        with contextlib.suppress(OSError):
            said = re.findall(r"iteration \d+/(\d+)", self.output.read_text(errors="replace"))
            planned = f" of {said[-1]}" if said else ""
        return f"iteration {self.iteration}{planned}" if self.iteration else "begins"

    def is_done(self, fingerprint: str) -> bool:
        """Are there results, of what the scene and its options still are?"""
        record = self.record
        there = all((self.folder / name).is_file() for name in ("ring.pt", "report.html"))
        return there and record.state == "done" and record.fingerprint == fingerprint


def jobs_of(scenes: Sequence[Path], out: Path, options: Sequence[str]) -> list[Job]:
    """A job for each scene. Raises InputError if two have the same name, or if results would go onto a scene."""
    jobs: dict[str, Job] = {}
    for scene in scenes:
        name = scene_name(scene)
        if name in jobs or name == RECORDS:
            other = f"{jobs[name].scene} is" if name in jobs else "records of batches are"
            raise InputError(f"{scene}: its results would go to {out / name}, where {other} to be; rename it, or "
                             "fit it in a batch of its own with another --out")  # fmt: skip
        folder = out.resolve() / name
        if folder in scene.resolve().parents:
            raise InputError(f"{folder}: --out: holds the scene file {scene.name} itself; choose another folder")
        jobs[name] = Job(scene.resolve(), folder, tuple(options))
    return list(jobs.values())
