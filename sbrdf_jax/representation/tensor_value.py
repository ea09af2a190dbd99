"""A lobe tensor's value in any direction; pure, for jit, vmap and grad."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sbrdf_jax.encoding import decode
from sbrdf_jax.records import LobeTensor
from sbrdf_jax.representation.direction_functions import direction_functions
from sbrdf_jax.splines import spline_weights

RANK_STEP = 8


def pad_ranks(tensor: LobeTensor) -> LobeTensor:
    """Return the same tensor with zeros up to ranks of a multiple of 8, so that most tensors share compiled code."""
    more = [-rank % RANK_STEP for rank in tensor.core.shape]
    if tensor.basis.kind != "data":
        more[3] = 0  # the config fixes how many
    if not any(more):
        return tensor
    core = np.asarray(tensor.core)
    names = ("theta_i_factor", "theta_o_factor", "direction_factor")
    factors = {name: np.pad(getattr(tensor, name), ((0, 0), (0, n))) for name, n in zip(names, more, strict=False)}
    basis = dataclasses.replace(
        tensor.basis,
        analysis=np.pad(tensor.basis.analysis, ((0, 0), (0, more[3]))),
        synthesis=np.pad(tensor.basis.synthesis, ((0, more[3]), (0, 0))),
    )
    return dataclasses.replace(tensor, **factors, core=np.pad(core, [(0, n) for n in more]), basis=basis)


def tensor_value(
    tensor: LobeTensor,
    theta_i: Float[Array, ""],
    theta_o: Float[Array, ""],
    phi_o: Float[Array, ""],
    wavelength_nm: Float[Array, " query"] | None = None,
) -> Float[Array, " wavelength"]:
    """Evaluate a lobe tensor in one direction [1/sr].

    Never negative, because it is clipped at 0; finite everywhere, and independent of phi_o
    where theta_i or theta_o is 0. Between incident angles the factors are cubic splines and the
    scale is one in its logarithm; beyond those with data they are the factors of the last one.
    """
    along_i = theta_i_functions(tensor, theta_i)
    at_i = along_i @ jnp.asarray(tensor.theta_i_factor)
    count_o = tensor.theta_o_factor.shape[0]
    at_o = spline_weights(theta_o * (2 / np.pi), count_o, jnp) @ jnp.asarray(tensor.theta_o_factor)
    functions = direction_functions(theta_i, theta_o, phi_o, tensor.half_angle_floor, jnp)
    at_direction = functions @ jnp.asarray(tensor.direction_factor)
    amplitude = jnp.tensordot(at_i, jnp.asarray(tensor.core), 1)
    coefficient = at_direction @ jnp.tensordot(at_o, amplitude, 1)
    scale = jnp.exp(-along_i @ jnp.asarray(tensor.log_scale))
    return jnp.maximum(decode(coefficient * scale, tensor.basis, wavelength_nm), 0.0)


def theta_i_functions(tensor: LobeTensor, theta_i: Float[Array, ""]) -> Float[Array, " theta_i_function"]:
    """Return the splines of theta_i; where nothing is interpolated over it, 1 at the nearest node."""
    count = tensor.theta_i_factor.shape[0]
    if not tensor.interpolate_theta_i:
        nodes = jnp.asarray(tensor.theta_i)
        return jax.nn.one_hot(jnp.argmin(jnp.abs(theta_i - nodes)), count, dtype=nodes.dtype)
    low, high = jnp.asarray(tensor.theta_i_range)
    width = jnp.where(high > low, high - low, 1.0)  # one incident angle alone: its factors everywhere
    return spline_weights((theta_i - low) / width, count, jnp)
