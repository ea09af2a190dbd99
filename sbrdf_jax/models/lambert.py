"""Lambert: the same in every direction, f = albedo / pi."""

from sbrdf_jax.models.model import Cosines, Model, lambert_term


def terms(c: Cosines, parameters):
    """Return the diffuse term."""
    del parameters
    return (lambert_term(c),)


MODEL = Model("lambert", (), terms)
