"""Path trace a capture of a mesh, with its ground truth: `python -m mi_ring.synthesize MESH OUT`."""

from collections.abc import Sequence

from mi_ring.synthesis.options import SynthesizeConfig, require_options
from mi_ring.synthesis.path_traced_capture import write_capture
from mi_ring.system import command
from mi_ring.system.files import locked


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    config = command.parse(SynthesizeConfig, arguments, "mi_ring.synthesize")
    require_options(config)
    with locked(config.out, "OUT"):
        write_capture(config)
    out = config.out
    exact = "" if config.exact else f"\nThe exact calibration is in {out}/truth/exact.xml."
    unknown = "environment" if config.environment else "lamps" if config.lamps > 1 else ""
    light = f" --light {unknown}" if unknown and config.wrong_room else ""
    print(f"{out}/scene.xml, and the true surface in {out}/truth/mesh.ply{exact}\n"
          f"Now: mi-ring check {out}/scene.xml; mi-ring fit {out}/scene.xml{light}")  # fmt: skip


if __name__ == "__main__":
    command.run("mi_ring.synthesize", main)
