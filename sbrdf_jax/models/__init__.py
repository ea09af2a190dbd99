"""Analytic reflectance models, one file each: their terms are pure functions, fitted by `fitting`."""

from sbrdf_jax.models import blinn_phong, cook_torrance, ggx, lafortune, lambert, phong, strauss, ward
from sbrdf_jax.models.model import Model as Model
from sbrdf_jax.models.model import Parameter as Parameter
from sbrdf_jax.models.model import model_value as model_value

MODELS: dict[str, Model] = {
    "lambert": lambert.MODEL,
    "phong": phong.MODEL,
    "blinn_phong": blinn_phong.MODEL,
    "lafortune": lafortune.MODEL,
    "ward": ward.MODEL,
    "cook_torrance": cook_torrance.MODEL,
    "ggx": ggx.MODEL,
    "strauss": strauss.MODEL,
}
