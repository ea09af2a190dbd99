"""`sbrdf footprint`: which directions of its materials a scene looks at, counted by Mitsuba."""

import argparse
from pathlib import Path

SUMMARY = "which directions of its materials a scene looks at; needs the extra `render`"
EXAMPLE = """\
example:
  sbrdf footprint configs/scenes/flat_patch.xml --output flat_patch.h5
  sbrdf run configs/quickstart.yaml 'scene={footprint: flat_patch.h5}' output.path=results/patch.h5

Every <bsdf id="NAME"> of the scene (Mitsuba's XML) is a material. Of several, name one: flat_patch.h5#NAME.
A picture of what was counted is written beside the file.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", metavar="SCENE.xml", help="a scene of Mitsuba 3")
    parser.add_argument("--output", required=True, metavar="FOOTPRINT.h5", help="the file to write")
    parser.add_argument("--step", type=float, default=7.5, metavar="DEG", help="size of a cell in each angle (7.5)")
    parser.add_argument("--width", type=int, default=64, metavar="PIXELS", help="of the small picture (64)")
    parser.add_argument("--samples", type=int, default=64, metavar="N", help="of each pixel (64)")


def run(args: argparse.Namespace) -> int:
    """Write the footprint and its picture; exit code 0."""
    from sbrdf_jax.errors import UserError

    if not (0 < args.step <= 45 and abs(90 / args.step - round(90 / args.step)) < 1e-9):
        raise UserError(f"--step: found {args.step:g}; expected a step that divides 90 degrees, such as 7.5")
    if Path(args.output).suffix == ".png":
        raise UserError(f"--output: found {args.output}, the name of its picture; expected FOOTPRINT.h5")
    if args.width < 1 or args.samples < 1:
        raise UserError(f"--width, --samples: found {args.width} and {args.samples}; expected at least 1 each")
    from sbrdf_jax.footprints import find_footprint
    from sbrdf_jax.masks import widen, write_footprint
    from sbrdf_jax.report.footprint_figure import footprint_figure
    from sbrdf_jax.report.style import save_figure, style_context

    found = find_footprint(Path(args.scene), step_deg=args.step, width=args.width, samples=args.samples)
    output = Path(args.output)
    write_footprint(output, found.axes, found.counts)
    picture = output.with_suffix(".png")
    with style_context():
        save_figure(footprint_figure(found), picture)
    for name, count in found.counts.items():
        needed = widen(count > 0)
        angles = f"{needed.any(axis=(1, 2)).sum()} of {len(needed)} incident angles"
        print(f"{output}: {name}: {100 * needed.mean():.1f} % of the cells, {angles}; picture {picture}")
    return 0
