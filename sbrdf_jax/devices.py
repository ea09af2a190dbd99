"""Where work is done: lanes on all devices of the process, and on the host what a processor does as well uncompiled."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "lanes"


@functools.cache
def on_host(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of `array_module`'s kind that NumPy computes where the processor is all that JAX has.

    There compiling it would take longer than computing it; on an accelerator it is `jax.jit` of the function.
    Arguments are arrays, or trees of them, of NumPy or JAX.
    """
    compiled = jax.jit(function)

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        if jax.default_backend() != "cpu":
            return compiled(*arguments)
        return function(*jax.tree.map(np.asarray, arguments))

    return call


def over_lanes(
    function: Callable[..., Any], *, axis: int, shared: tuple[int, ...] = (), static: tuple[int, ...] = ()
) -> Callable[..., Any]:
    """Return `jax.jit` of a function whose lanes do not depend on each other, shared out among the devices.

    Args:
        function: Every array that it takes (but for those named next) and every array that it
            returns has the lanes on one axis.
        axis: That axis: 0, or -1 for the last.
        shared: Places of the arguments that are the same for all lanes; every device gets a copy.
        static: Places of the arguments that select the compiled code.

    Returns:
        The function, by positional arguments. On one device, without lanes and under another
        transformation (`jit`, `vmap`, `grad`) it is `jax.jit` of `function`, no more. So it is where
        `jax.default_device` names a device, which then works alone.

    Numerics:
        A loop of a batched solver asks at every step whether any lane still moves. One program for
        all devices would have to ask all of them, a collective at every step, and let all wait for
        the slowest lane. Under `shard_map` each device runs the function on its own lanes and
        stops by itself; nothing is exchanged. Lanes are filled up to a multiple of the devices
        with copies of the last one, which are cut off. The answers come back through the host
        to where they would be without this, so that whatever follows runs as on one device: right
        for arrays of some megabytes that a device works on for seconds. They differ from those of
        one device by the rounding of products of another width.
    """
    on_one = jax.jit(function, static_argnums=static)
    on_all = jax.jit(functools.partial(_on_all, function, axis, shared, static), static_argnums=(0, *_shifted(static)))

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        devices = jax.local_devices()
        if len(devices) == 1 or jax.config.jax_default_device is not None:
            return on_one(*arguments)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments)):
            return on_one(*arguments)
        lanes = [a for place, a in enumerate(arguments) if place not in shared + static]
        count = jax.tree.leaves(lanes)[0].shape[axis]
        if count == 0:
            return on_one(*arguments)
        mesh = Mesh(np.array(devices), (AXIS,))
        index = np.minimum(np.arange(-(-count // len(devices)) * len(devices)), count - 1)

        def put(place: int, argument: Any) -> Any:
            if place in static:
                return argument
            if place in shared:
                return jax.device_put(argument, NamedSharding(mesh, PartitionSpec()))
            filled = jax.tree.map(lambda leaf: np.asarray(leaf).take(index, axis), argument)
            return jax.tree.map(lambda leaf: jax.device_put(leaf, NamedSharding(mesh, _split(leaf, axis))), filled)

        found = on_all(mesh, *(put(place, argument) for place, argument in enumerate(arguments)))
        return jax.tree.map(lambda leaf: _home(leaf, count, axis), found)

    return call


def _on_all(function, axis, shared, static, mesh, *arguments):
    """Run the function on each device's lanes; traced once for each set of shapes.

    It is traced for the lanes of one device before there is a mesh, because lineax compares
    shapes that inside `shard_map` know of theirs, with shapes that do not.
    """
    places = [place for place in range(len(arguments)) if place not in static]
    arrays = tuple(arguments[place] for place in places)
    specs = tuple(
        jax.tree.map(lambda leaf, place=place: PartitionSpec() if place in shared else _split(leaf, axis), array)
        for place, array in zip(places, arrays, strict=True)
    )
    own = jax.tree.map(
        lambda leaf, spec: jax.ShapeDtypeStruct(NamedSharding(mesh, spec).shard_shape(leaf.shape), leaf.dtype),
        arrays,
        specs,
    )

    def on_own_lanes(*arrays):
        given = dict(zip(places, arrays, strict=True))
        return function(*(given.get(place, argument) for place, argument in enumerate(arguments)))

    traced, answer = jax.make_jaxpr(on_own_lanes, return_shape=True)(*own)
    leaves, structure = jax.tree.flatten(answer)
    found = jax.shard_map(
        lambda *arrays: jaxpr_as_fun(traced)(*jax.tree.leaves(arrays)),
        mesh=mesh,
        in_specs=specs,
        out_specs=[_split(leaf, axis) for leaf in leaves],
        check_vma=False,
    )(*arrays)
    return jax.tree.unflatten(structure, found)


def _home(leaf: jax.Array, count: int, axis: int) -> jax.Array:
    """Bring the first lanes of an array that lies on all devices to the one where arrays are made."""
    return jnp.asarray(np.asarray(leaf).take(np.arange(count), axis))


def _split(leaf: Any, axis: int) -> PartitionSpec:
    """Return how an array is split: along its axis of lanes."""
    return PartitionSpec(*(AXIS if place == axis % leaf.ndim else None for place in range(leaf.ndim)))


def _shifted(places: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(place + 1 for place in places)
