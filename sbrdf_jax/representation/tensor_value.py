"""A lobe tensor's value in any direction; pure, for jit, vmap and grad."""

import dataclasses

import numpy as np
from jaxtyping import Float

from sbrdf_jax.array_module import AnyArray, array_module
from sbrdf_jax.encoding import decode
from sbrdf_jax.records import LobeTensor
from sbrdf_jax.representation.direction_functions import direction_functions
from sbrdf_jax.splines import spline_weights

RANK_STEP = 8


def pad_ranks(tensor: LobeTensor) -> LobeTensor:
    """Return the same tensor with zeros up to ranks of a multiple of 8, so that most tensors share compiled code."""
    more = [-rank % RANK_STEP for rank in tensor.core.shape]
    if not tensor.basis.stores_vectors:
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
    theta_i: Float[AnyArray, "*#shape"],
    theta_o: Float[AnyArray, "*#shape"],
    phi_o: Float[AnyArray, "*#shape"],
    wavelength_nm: Float[AnyArray, " query"] | None = None,
) -> Float[AnyArray, "*shape wavelength"]:
    """Evaluate a lobe tensor in directions whose angles broadcast [1/sr]; what depends on few angles is summed once.

    Never negative, because it is clipped at 0; finite everywhere, and independent of phi_o
    where theta_i or theta_o is 0. Between incident angles the factors are cubic splines and the
    scale is one in its logarithm; beyond those with data they are the factors of the last one.
    """
    xp, polar = array_module(theta_i, tensor.core), np.broadcast_shapes(np.shape(theta_i), np.shape(theta_o))
    along_i = theta_i_functions(tensor, theta_i)
    at_i = along_i @ tensor.theta_i_factor
    at_o = spline_weights(theta_o * (2 / np.pi), tensor.theta_o_factor.shape[0]) @ tensor.theta_o_factor
    factor = tensor.direction_factor
    at_direction = direction_functions(theta_i, theta_o, phi_o, tensor.half_angle_floor, factor.shape[0]) @ factor
    _, rank_o, rank_direction, _ = tensor.core.shape
    amplitude = xp.tensordot(at_i, tensor.core, 1).reshape(*np.shape(theta_i), rank_o, -1)
    amplitude = (at_o[..., None, :] @ amplitude).reshape(*polar, rank_direction, -1)
    coefficient = (at_direction[..., None, :] @ amplitude)[..., 0, :]
    scale = xp.exp(-along_i @ tensor.log_scale)
    return xp.maximum(decode(coefficient * scale[..., None], tensor.basis, wavelength_nm), 0.0)


def tensor_on_axes(
    tensor: LobeTensor, theta_i: Float[AnyArray, ""], theta_o: Float[AnyArray, " o"], phi_o: Float[AnyArray, " p"]
) -> Float[AnyArray, "o p wavelength"]:
    """`tensor_value` at all combinations of two axes, at one incident angle."""
    return tensor_value(tensor, theta_i.reshape(1, 1), theta_o[:, None], phi_o[None, :])


def theta_i_functions(
    tensor: LobeTensor, theta_i: Float[AnyArray, "*shape"]
) -> Float[AnyArray, "*shape theta_i_function"]:
    """Return the splines of theta_i; where nothing is interpolated over it, 1 at the nearest node."""
    xp, count = array_module(theta_i, tensor.theta_i), tensor.theta_i_factor.shape[0]
    if not tensor.interpolate_theta_i:
        nodes = tensor.theta_i.reshape((1,) * np.ndim(theta_i) + (-1,))
        nearest = xp.argmin(xp.abs(theta_i[..., None] - nodes), axis=-1)
        return xp.eye(count, dtype=tensor.theta_i.dtype)[nearest]
    low, high = tensor.theta_i_range
    width = xp.where(high > low, high - low, 1.0)  # one incident angle alone: its factors everywhere
    return spline_weights((theta_i - low) / width, count)
