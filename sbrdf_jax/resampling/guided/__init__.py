"""The guided method: a robust lobe model, and a smooth residual in coordinates where a glossy field is smooth."""

from sbrdf_jax.resampling.guided.field import GuidedField, evaluate_guided, evaluate_standard_error
from sbrdf_jax.resampling.guided.fit import GuidedReport, fit_guided
from sbrdf_jax.resampling.guided.nodes import GuidedResult, resample_guided

__all__ = [
    "GuidedField",
    "GuidedReport",
    "GuidedResult",
    "evaluate_guided",
    "evaluate_standard_error",
    "fit_guided",
    "resample_guided",
]
