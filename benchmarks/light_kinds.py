"""Does `--light auto` find the kind of light? Small captures of known kind are made, and coarse fits choose.

    python benchmarks/light_kinds.py MESH … [--count 20] [--kinds KIND …] [--views 24] [--size 128]
                                     [--out out/light_kinds]

Captures take meshes and five kinds of light in turn: a flash in the dark; a flash in a room that the scene file does
not mention; a room with windows; the same, on a turntable; a lamp. Without a flash the scene file names no light. The
four materials, from matte to brass, change after every five captures.

Prints a Markdown table with machine and date: kind, material, what was chosen, and how long it took.
"""

import argparse
import datetime
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import torch
from accuracy import processor, product_speed, table
from environments import run

import mi_ring
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.light_selection import choose_lighting

MATERIALS = {
    "matte": "diffuse reflectance=0.5,0.4,0.3", "gloss": "principled base_color=0.6,0.45,0.3 roughness=0.4",
    "polish": "principled base_color=0.5,0.3,0.1 roughness=0.15", "brass": "brass",
}  # fmt: skip


class Kind(NamedTuple):
    """A kind of light: options of mi-ring synthesize, and the light that is right."""

    options: tuple[object, ...]
    right: str
    named: bool = True  #: Does the scene file name the photographs' lights?


ROOM = ("--light", "none", "--room", 1, "--room-kind", "windows", "--wrong-room")
KINDS = {
    "flash": Kind((), "capture"),
    "flash in a room": Kind(("--room", 0.15, "--room-kind", "harmonics", "--wrong-room"), "capture"),
    "windows": Kind(ROOM, "environment", named=False),
    "turntable": Kind((*ROOM, "--cameras", "turntable", "--elevations", 10, 45), "turntable", named=False),
    "lamp": Kind(("--light", "lamp"), "lamps", named=False),
}


def without_lights(scene: Path) -> Path:
    """A copy of a scene file whose photographs have no lights. Returns its path."""
    path, root = scene.with_name("unlit.xml"), ElementTree.parse(scene).getroot()
    for sensor in root.findall("sensor"):
        for emitter in sensor.findall("emitter"):
            sensor.remove(emitter)
    path.write_bytes(ElementTree.tostring(root))
    return path


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument(
        "--kinds", nargs="+", choices=KINDS, default=[*KINDS], help="those of the captures that are made"
    )
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--out", type=Path, default=Path("out/light_kinds"))
    args = parser.parse_args()
    rows, right = [], 0
    for k in range(args.count):
        name, material = list(KINDS)[k % len(KINDS)], list(MATERIALS)[k // len(KINDS) % len(MATERIALS)]
        if name not in args.kinds:
            continue
        kind, out = KINDS[name], args.out / str(k)
        mesh = args.meshes[(k + k // len(KINDS)) % len(args.meshes)]  # so that no mesh always meets the same kind
        run("mi_ring.synthesize", mesh, out, "--material", MATERIALS[material], "--views",
            args.views, "--size", args.size, args.size, "--novel", 0, "--spp", 25, "--seed", k,
            *kind.options)  # fmt: skip
        scene, start = out / "scene.xml", time.monotonic()
        capture = mi_ring.load_capture(scene if kind.named else without_lights(scene))
        try:
            found = choose_lighting(capture, Config(light="auto"))
            right += found.kind == kind.right
        except InputError as error:
            found = error
        rows.append([name, material, str(found), f"{time.monotonic() - start:.0f}"])
        print(k, *rows[-1], sep=", ", file=sys.stderr, flush=True)
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}, {speed:.0f} GFLOP/s; {datetime.date.today()}; {args.views} photographs of {args.size}²; "
          f"{right} of {len(rows)} right\n")  # fmt: skip
    print(table(["light", "material", "chosen", "s"], rows))


if __name__ == "__main__":
    main()
