"""Show that a batch of fits loses nothing, whatever is killed: six scenes, processes and workers killed at random.

    python benchmarks/batch.py [SCENE.xml] [--scenes 6] [--kills 12] [--seed 0]

Copies of a scene are fitted, tiny and deterministic, by `mi-ring batch` while the processes of fits, Ray's workers and,
now and then, the batch itself (which is then called again) get SIGKILL. In the end all results must be there, and equal
bit for bit to that of a fit that nobody has killed. It needs the extra `batch`, psutil, and Linux.
"""

import argparse
import datetime
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from accuracy import processor

OPTIONS = ["--iterations", "40", "--levels", "2", "--widths", "32", "--shares", "1", "--subdivisions", "2", "--batch",
           "2", "--domain", "sphere", "--deterministic"]  # fmt: skip
KINDS = "fit", "worker", "batch"
ODDS = 4, 4, 1  #: of each kind


def main() -> None:
    """The command. Exits with 1 if a result is missing or another."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", nargs="?", type=Path, default=Path("scenes/pot2.xml"))
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kills", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng, killed = random.Random(options.seed), dict.fromkeys(KINDS, 0)
    with tempfile.TemporaryDirectory(prefix="batch-") as place:
        folder = Path(place)
        shutil.copytree(options.scene.parent, folder / "captures")
        whole = (folder / "captures" / options.scene.name).read_text()
        scenes = [folder / "captures" / f"scene{k}.xml" for k in range(options.scenes)]
        for scene in scenes:
            scene.write_text(whole)
        reference = [sys.executable, "-m", "mi_ring.fit", str(scenes[0]), "--out", str(folder / "reference"), *OPTIONS]
        subprocess.run(reference, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        command = [sys.executable, "-m", "mi_ring.batch", *map(str, scenes), "--out", str(folder / "out"), "--workers",
                   str(options.workers), "--cpus", "1", "--retries", "50", "--", *OPTIONS]  # fmt: skip
        started, batch = time.monotonic(), subprocess.Popen(command)
        while batch.poll() is None:
            time.sleep(rng.uniform(2, 10))
            running = psutil.process_iter(["cmdline"])
            fits = [p for p in running if f"--out\0{folder}/out/" in "\0".join(p.info["cmdline"] or [])]
            if sum(killed.values()) < options.kills and fits:
                kind, victim = rng.choices(KINDS, ODDS)[0], rng.choice(fits)
                try:
                    {"fit": victim, "worker": victim.parent(), "batch": psutil.Process(batch.pid)}[kind].kill()
                except psutil.NoSuchProcess:
                    continue
                killed[kind] += 1
                if kind == "batch":
                    batch.wait()
                    time.sleep(5)  # what it has begun ends with it
                    batch = subprocess.Popen(command)
        seconds = time.monotonic() - started
        expected = (folder / "reference/mesh.ply").read_bytes()
        meshes = [folder / f"out/{scene.stem}/mesh.ply" for scene in scenes]
        same = [mesh.is_file() and mesh.read_bytes() == expected for mesh in meshes]
        print(
            f"{processor()}; {datetime.date.today()}; {options.scene}, seed {options.seed}: killed {killed['fit']} "
            f"fits, {killed['worker']} workers, {killed['batch']} batches in {seconds:.0f} s; {sum(same)} of "
            f"{len(same)} results complete and equal to the undisturbed one; exit status {batch.returncode}"
        )
        sys.exit(int(not all(same) or batch.returncode != 0))


if __name__ == "__main__":
    main()
