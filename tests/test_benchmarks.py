"""The scripts that print what fits cost still fit the package, of which they watch inner parts."""

import json
import subprocess
import sys
from pathlib import Path

CODE = """
import json, sys
from pathlib import Path
import cost
settings = {"level": 2, "width": 28, "batch": 2, "steps": 3, "spp": 1}
print(json.dumps(cost.iterations(Path(sys.argv[1]), "default", settings)))
"""


def test_the_parts_of_an_iteration_are_seen(small_capture):
    folder = Path(__file__).parents[1] / "benchmarks"
    command = [sys.executable, "-c", CODE, str(small_capture)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder)
    measured = json.loads(done.stdout.splitlines()[-1])
    parts = measured["parts"]
    assert parts.keys() == {"flow", "rendering", "optimiser"} and all(seconds > 0 for seconds in parts.values())
    assert sum(parts.values()) < measured["total"]
