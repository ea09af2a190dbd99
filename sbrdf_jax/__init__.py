"""Scattered spectral BRDF measurements to a clean grid, to a compact form, and back.

The functional API: `read -> clean -> make_grid -> resample -> encode_field -> represent`, and
`evaluate` for the answer of any stage. Names are imported when they are first used, so that
importing the package costs nothing.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sbrdf_jax.cleaning import clean as clean
    from sbrdf_jax.config import load_config as load_config
    from sbrdf_jax.config import resolve as resolve
    from sbrdf_jax.encoding import data_basis as data_basis
    from sbrdf_jax.encoding import decode as decode
    from sbrdf_jax.encoding import encode as encode
    from sbrdf_jax.encoding import encode_field as encode_field
    from sbrdf_jax.encoding import make_basis as make_basis
    from sbrdf_jax.errors import UserError as UserError
    from sbrdf_jax.evaluation import evaluate as evaluate
    from sbrdf_jax.evaluation import evaluate_in_chunks as evaluate_in_chunks
    from sbrdf_jax.formats import read as read
    from sbrdf_jax.grid import make_grid as make_grid
    from sbrdf_jax.harmonics import real_harmonics as real_harmonics
    from sbrdf_jax.lobes import lobe_value as lobe_value
    from sbrdf_jax.nnls import DenseNormal as DenseNormal
    from sbrdf_jax.nnls import ProjectedNewton as ProjectedNewton
    from sbrdf_jax.nnls import solve_nnls as solve_nnls
    from sbrdf_jax.options import InputOptions as InputOptions
    from sbrdf_jax.options import RunOptions as RunOptions
    from sbrdf_jax.pipeline import prepare as prepare
    from sbrdf_jax.pipeline import process as process
    from sbrdf_jax.progress import Progress as Progress
    from sbrdf_jax.records import CompactBRDF as CompactBRDF
    from sbrdf_jax.records import GriddedBRDF as GriddedBRDF
    from sbrdf_jax.records import LobeHarmonics as LobeHarmonics
    from sbrdf_jax.records import LobeTensor as LobeTensor
    from sbrdf_jax.records import RawSamples as RawSamples
    from sbrdf_jax.records import SpectralField as SpectralField
    from sbrdf_jax.records import Status as Status
    from sbrdf_jax.representation import represent as represent
    from sbrdf_jax.resampling import resample as resample
    from sbrdf_jax.store import RunResult as RunResult
    from sbrdf_jax.store import load as load
    from sbrdf_jax.store import load_stage as load_stage
    from sbrdf_jax.store import save as save

_HOME = {
    "cleaning": ("clean",),
    "config": ("load_config", "resolve"),
    "encoding": ("data_basis", "decode", "encode", "encode_field", "make_basis"),
    "errors": ("UserError",),
    "evaluation": ("evaluate", "evaluate_in_chunks"),
    "formats": ("read",),
    "grid": ("make_grid",),
    "harmonics": ("real_harmonics",),
    "lobes": ("lobe_value",),
    "nnls": ("DenseNormal", "ProjectedNewton", "solve_nnls"),
    "options": ("InputOptions", "RunOptions"),
    "pipeline": ("prepare", "process"),
    "progress": ("Progress",),
    "records": ("CompactBRDF", "GriddedBRDF", "LobeHarmonics", "LobeTensor", "RawSamples", "SpectralField", "Status"),
    "representation": ("represent",),
    "resampling": ("resample",),
    "store": ("RunResult", "load", "load_stage", "save"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str):
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
