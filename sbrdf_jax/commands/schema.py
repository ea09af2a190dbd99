"""`sbrdf schema`: the JSON schema of a config, for editors."""

import argparse
import json

SUMMARY = "Print the JSON schema of a config, for editors."
EXAMPLE = """example:
  sbrdf schema > sbrdf.schema.json

then, as the first line of a config, for editors with the YAML language server:
  # yaml-language-server: $schema=sbrdf.schema.json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no arguments: the schema is always the whole one."""


def run(args: argparse.Namespace) -> int:
    """Print the schema; exit code 0."""
    from sbrdf_jax.option_checks import json_schema

    print(json.dumps(json_schema(), indent=2))
    return 0
