"""How many numbers each incident angle and each coefficient gets: by the error that a number takes away.

Every incident angle has several sets of lobes to choose from; for each, every coefficient has a
degree of its background, from "none" on. Choices that another one betters in size and error are
dropped (the lower convex hull), first for each coefficient, then for the incident angle.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

POWER = 0.5  # of the squared error that counts, summed over incident angles: eta itself


class Choice(NamedTuple):
    """One way to store an incident angle."""

    numbers: int
    error: float  # squared, relative
    lobes: int  # place among the sets of lobes
    degree: Int[np.ndarray, " channel"]  # -1: nothing stored


class Ladder(NamedTuple):
    """Steps from nothing on, for one set of lobes: the best gain for each number first."""

    channel: Int[np.ndarray, " step"]
    degree: Int[np.ndarray, " step"]  # which the step raises its channel to
    numbers: Int[np.ndarray, " step"]  # that it costs
    gain: Float[np.ndarray, " step"]  # that it takes off the squared error


def make_ladder(
    error: Float[np.ndarray, "degree channel"], cost: Int[np.ndarray, " degree"], *, same_degree: bool
) -> Ladder:
    """Return the steps along the lower convex hull of every channel.

    Args:
        error: Squared error of every channel by degree, from -1 on.
        cost: Numbers of a channel, 0 at degree -1.
        same_degree: All channels go together; they are then one, of number 0.
    """
    curves = [error.sum(axis=1)] if same_degree else list(error.T)
    cost = cost * error.shape[1] if same_degree else cost
    steps = []
    for channel, own in enumerate(curves):
        hull = lower_hull(cost, own)
        steps += [
            (channel, b - 1, cost[b] - cost[a], own[a] - own[b]) for a, b in zip(hull[:-1], hull[1:], strict=True)
        ]
    columns = np.array(steps, float).reshape(-1, 4).T
    columns = columns[:, np.argsort(-columns[3] / columns[2], kind="stable")]
    return Ladder(*columns[:3].astype(int), columns[3])


def angle_choices(ladders: list[Ladder], energy: float, num_channels: int) -> list[Choice]:
    """Return the choices of one incident angle that no mixture of others betters, from the smallest on.

    Args:
        ladders: Of each set of lobes.
        energy: Squared error where nothing is stored.
        num_channels: Channels that may be used, the first ones.
    """
    numbers, left, place = [], [], []
    allowed = [ladder.channel < num_channels for ladder in ladders]
    for number, (ladder, may) in enumerate(zip(ladders, allowed, strict=True)):
        count = int(may.sum()) + 1
        numbers.append(np.concatenate([[0], ladder.numbers[may].cumsum()]))
        left.append(energy - np.concatenate([[0.0], ladder.gain[may].cumsum()]))
        place.append(np.stack([np.full(count, number), np.arange(count)], axis=1))
    numbers, left, place = np.concatenate(numbers), np.maximum(np.concatenate(left), 0.0), np.concatenate(place)
    choices = []
    for k in lower_hull(numbers, left**POWER):
        lobes, count = place[k]
        may = np.flatnonzero(allowed[lobes])[:count]
        degree = np.full(num_channels, -1)
        np.maximum.at(degree, ladders[lobes].channel[may], ladders[lobes].degree[may])
        choices.append(Choice(int(numbers[k]), float(left[k]), int(lobes), degree))
    return choices


def lower_hull(size: Float[np.ndarray, " n"] | Int[np.ndarray, " n"], error: Float[np.ndarray, " n"]) -> list[int]:
    """Return the places of the lower convex hull that falls, in order of size."""
    order = np.lexsort((error, size))
    lowest = np.minimum.accumulate(error[order])
    order = order[np.concatenate([[True], lowest[1:] < lowest[:-1]])]
    x, y = size[order].tolist(), error[order].tolist()
    hull: list[int] = []
    for k in range(len(order)):
        while len(hull) > 1:
            a, b = hull[-2:]
            if (y[b] - y[a]) * (x[k] - x[b]) < (y[k] - y[b]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(k)
    return [int(order[k]) for k in hull]


def spend(choices: list[list[Choice]], budget: float) -> list[int]:
    """Return which choice each incident angle takes so that the sum of their eta is least within a budget.

    Steps along the hulls of all incident angles, the one with the greatest gain for each number
    first; one that no longer fits ends its own incident angle. The first choice is taken in any case.
    """
    taken = [0] * len(choices)
    left = budget - sum(own[0].numbers for own in choices)
    steps = []
    for i, own in enumerate(choices):
        for k, (before, after) in enumerate(zip(own[:-1], own[1:], strict=True)):
            gain = before.error**POWER - after.error**POWER
            steps.append((-gain / (after.numbers - before.numbers), i, k + 1, after.numbers - before.numbers))
    ended = set()
    for _, i, k, more in sorted(steps):
        if i in ended:
            continue
        if more > left:
            ended.add(i)
            continue
        taken[i], left = k, left - more
    return taken
