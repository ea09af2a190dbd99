"""`sbrdf sample`: the embedded sample as a raw file, a template for one's own data."""

import argparse

SUMMARY = "write the embedded sample as a raw file, a template for your own data"
EXAMPLE = """\
examples:
  sbrdf sample amber_glass --output amber.csv
  sbrdf sample amber_glass_sharp --output sharp.h5 --seed 7 --noise 0.5

names: amber_glass, amber_glass_sharp, amber_glass_broad
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("name", metavar="NAME", help="which embedded sample, for example amber_glass")
    parser.add_argument("--output", required=True, metavar="FILE", help="FILE.h5 or FILE.csv")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of directions and noise (0)")
    parser.add_argument("--count", type=int, metavar="N", help="directions per incident angle (770)")
    parser.add_argument("--noise", type=float, default=1.0, metavar="X", help="factor on the noise (1); 0: none")


def run(args: argparse.Namespace) -> int:
    """Write the file; exit code 0."""
    from sbrdf_jax.builtin import measure
    from sbrdf_jax.formats import check_writable_name, write_samples

    check_writable_name(args.output)
    samples = measure(args.name, seed=args.seed, count=args.count, noise=args.noise)
    write_samples(args.output, samples)
    size = f"{samples.num_samples} samples x {len(samples.wavelength_nm)} wavelengths"
    print(f"{args.output}: {size} of {samples.source}")
    return 0
