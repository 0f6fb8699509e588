"""Writes and reads checkpoints, from which `--resume` continues, and tests whether input files have changed since."""

import contextlib
from pathlib import Path

from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.fitting.config import WEIGHTS, Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.setting_types import as_typed
from mi_ring.fitting.start import StateError
from mi_ring.objects.ring_file import read_state
from mi_ring.system.files import digest, is_sealed, relative_to, write_state
from mi_ring.version import __version__

NAME = "checkpoint.pt"
BEFORE = "checkpoint.before.pt"  #: the previous checkpoint, in case the newest is damaged
FORMAT = 11  #: of checkpoints; others are refused
ADVICE = "run without --resume to start anew"


def read_checkpoint(folder: Path, config: Config) -> dict:
    """Read the newest checkpoint in `folder`. If it is damaged or missing, read the previous one and print a message.

    Returns the content of the checkpoint. `config`: the settings of the fit that is to continue. Raises InputError if
    no checkpoint can be read, or if it was made with other settings.
    """
    path = folder / NAME
    try:
        state = read_state(path, "a checkpoint", ADVICE)
    except InputError as error:
        before = folder / BEFORE
        try:
            state = read_state(before, "a checkpoint", ADVICE)
        except InputError:
            raise error from None
        print(f"{path}: is damaged or gone; going on from the one before, {before}")
        path = before
    parts = [state.get(name) for name in ("settings", "files", "fit")]
    if isinstance(parts[0], dict):
        parts.append(parts[0].get("weights", {}))
    if isinstance(found := state.get("format"), int) and found != FORMAT:
        raise InputError(f"{path}: is a checkpoint of format {found}, mi_ring {__version__} goes on from {FORMAT}; go "
                         f"on with the version that wrote it, or {ADVICE}")  # fmt: skip
    if found != FORMAT or not all(isinstance(part, dict) for part in parts):
        raise InputError(f"{path}: holds no checkpoint; {ADVICE}")
    known = Config().settings() | state["settings"]  # settings that are newer than the checkpoint had their defaults
    known["weights"] = WEIGHTS | known["weights"]
    known, asked, default = (by_option(settings) for settings in (known, config.settings(), Config().settings()))
    differing = []
    for name, value in asked.items():
        if (was := known[name]) != value:
            now = f"{as_typed(value)} now{', the default' * (value == default[name])}"
            differing.append(f"--{name.replace('_', '-')}: was {as_typed(was)} before, is {now}")
    if differing:
        raise InputError(f"{path}: {'; '.join(differing)}; give the same settings, --preset among them, or start anew "
                         "without --resume")  # fmt: skip
    return state


def by_option(settings: dict) -> dict:
    """Convert settings to a dict with one entry per command-line option. Returns a new dict.

    Its entries `weights.NAME`, one for each weight of the loss, replace the dict `weights` in `settings`.
    """
    weights = {f"weights.{name}": value for name, value in settings["weights"].items()}
    return {name: value for name, value in settings.items() if name != "weights"} | weights


def require_same_files(state: dict, capture: Capture, config: Config, folder: Path) -> None:
    """Raise InputError if a file that the fit reads has changed since the checkpoint was written.

    `state`: content of the checkpoint. `config`: settings of the fit. `folder`: the results folder, for the message.
    """
    before, now = state["files"], digests(capture, config)
    for name in sorted(before.keys() | now.keys()):
        if before.get(name) != now.get(name):
            raise InputError(f"{folder / NAME}: --resume: {name} has changed since, or is another file; start anew "
                             "without --resume")  # fmt: skip


def resumed(state: dict, capture: Capture, config: Config, folder: Path) -> Fit:
    """Make a fit that continues from a checkpoint.

    `state`: content of the checkpoint. `folder`: the results folder, for messages. Raises InputError if the state is
    not that of a fit, or if a file of the capture has changed since the checkpoint was written.
    """
    require_same_files(state, capture, config, folder)
    try:
        return Fit(capture, config, state=state["fit"])
    except StateError as error:
        raise InputError(f"{folder / NAME}: holds no fit that could go on ({error}); {ADVICE}") from error


def write_checkpoint(fit: Fit, files: dict[str, str], folder: Path) -> None:
    """Write a checkpoint of `fit` into `folder`, and keep the previous checkpoint.

    `files`: a dict from the names of the fit's input files to hashes of their content, to recognise changed files
    later. Raises InputError if the checkpoint cannot be written.
    """
    state = {"format": FORMAT, "settings": fit.problem.config.settings(), "files": files, "fit": fit.state()}
    path = folder / NAME
    whole = False
    with contextlib.suppress(OSError):  # there is none, or it cannot be read
        whole = is_sealed(path.read_bytes())  # a damaged file must not replace a good one
    write_state(state, path, folder / BEFORE if whole else None)


def digests(capture: Capture, config: Config) -> dict[str, str]:
    """Hash every file that a fit reads, except textures.

    Returns a dict from file names to hashes. The names are relative to the folder of the scene file.
    """
    files = {capture.path, capture.shape.domain_file}
    files |= {file for shot in capture.shots for file in shot.files}
    if isinstance(config.domain, tuple):
        files.add(Path(config.domain[1]))
    return {relative_to(capture.path.parent, file): digest(file) for file in files if file}
