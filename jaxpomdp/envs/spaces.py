"""Any Gymnasium environment as channels of observations: its spaces as arrays that an agent can model."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from gymnasium import Space

SUPPORTED = "Discrete, MultiDiscrete, MultiBinary, Box, or a Tuple or Dict of these"


class ChannelSpec(NamedTuple):
    """One channel of an observation.

    Attributes:
        kind: ``"categorical"`` (one of ``0..size - 1``) or ``"gaussian"`` (a vector of ``size`` numbers).
        size: how many values, or how many dimensions.
        name: where in the space it comes from, for messages and pictures.
    """

    kind: Literal["categorical", "gaussian"]
    size: int
    name: str = "observation"


class ActionSpec(NamedTuple):
    """Actions ``0..count - 1`` of an agent; the environment calls the first one ``first``."""

    count: int
    first: int


def channels_of(space: Space, name: str = "observation") -> tuple[ChannelSpec, ...]:
    """Say which channels the observations of a space consist of.

    ``Discrete(n)`` is one categorical channel; ``MultiDiscrete`` and ``MultiBinary`` are one for each
    component (row by row); ``Box`` is one Gaussian channel of all its components; ``Tuple`` and ``Dict`` are
    the channels of their parts in the space's own order.

    Raises:
        TypeError: the space, or a part of it, is of another kind.
        ValueError: a ``Box`` without components.

    Example:
        >>> from gymnasium.spaces import Box, Discrete, Tuple
        >>> [channel[:2] for channel in channels_of(Tuple([Discrete(5), Box(-1, 1, (2, 3))]))]
        [('categorical', 5), ('gaussian', 6)]
    """
    from gymnasium import spaces

    if isinstance(space, spaces.Discrete):
        return (ChannelSpec("categorical", int(space.n), name),)
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        sizes = _component_sizes(space)
        return tuple(ChannelSpec("categorical", int(n), f"{name}[{i}]") for i, n in enumerate(sizes))
    if isinstance(space, spaces.Box):
        if math.prod(space.shape) < 1:
            raise ValueError(f"{name} must have at least one component, got a Box of shape {space.shape}")
        return (ChannelSpec("gaussian", math.prod(space.shape), name),)
    parts = _parts(space, name)
    return tuple(channel for key, part in parts for channel in channels_of(part, f"{name}[{key!r}]"))


def encode(observation: Any, space: Space, name: str = "observation") -> tuple[np.ndarray, ...]:
    """Turn one observation of a space, or a batch of them, into one array for each channel.

    Args:
        observation: an element of ``space``; or a batch as of Gymnasium's vector environments, every array
            with the same leading axes ``[...]``.
        space: of a single observation.
        name: of the argument, for messages.

    Returns:
        For each channel int32 ``[...]`` counting from 0, or float32 ``[..., D]``.

    Raises:
        TypeError: the space, or a part of it, is of another kind than :func:`channels_of` knows.
        ValueError: a value is out of range, not finite, or of the wrong shape.

    Example:
        >>> from gymnasium.spaces import Discrete, MultiBinary
        >>> encode(np.int64(7), Discrete(3, start=5))
        (array(2, dtype=int32),)
        >>> [array.tolist() for array in encode([[1, 0], [1, 1]], MultiBinary(2))]
        [[1, 1], [0, 1]]
    """
    from gymnasium import spaces

    if isinstance(space, spaces.Discrete):
        return (_checked(np.asarray(observation) - int(space.start), int(space.n), name),)
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        return _encode_components(observation, space, name)
    if isinstance(space, spaces.Box):
        vector = _flat(np.asarray(observation, np.float32), space.shape, name)
        if not np.all(np.isfinite(vector)):
            raise ValueError(f"{name} must be finite, got {observation}")
        return (vector,)
    parts = _parts(space, name)
    return tuple(array for key, part in parts for array in encode(observation[key], part, f"{name}[{key!r}]"))


def actions_of(space: Space) -> ActionSpec:
    """Say how many actions a space has.

    Raises:
        TypeError: the space is not ``Discrete``.

    Example:
        >>> from gymnasium.spaces import Discrete
        >>> actions_of(Discrete(4))
        ActionSpec(count=4, first=0)
    """
    from gymnasium import spaces

    if not isinstance(space, spaces.Discrete):
        raise TypeError(f"the action space must be Discrete, got {space}")
    return ActionSpec(int(space.n), int(space.start))


def _parts(space: Space, name: str) -> list[tuple[Any, Space]]:
    from gymnasium import spaces

    if isinstance(space, spaces.Tuple):
        return list(enumerate(space.spaces))
    if isinstance(space, spaces.Dict):
        return list(space.spaces.items())
    raise TypeError(f"{name} must come from a space that is {SUPPORTED}, got {space}")


def _component_sizes(space: Any) -> np.ndarray:
    sizes = getattr(space, "nvec", None)
    return np.full(math.prod(space.shape), 2) if sizes is None else np.ravel(sizes)


def _encode_components(observation: Any, space: Any, name: str) -> tuple[np.ndarray, ...]:
    flat = _flat(np.asarray(observation), space.shape, name)
    flat = flat - np.ravel(getattr(space, "start", np.zeros(space.shape, int)))
    sizes = _component_sizes(space)
    return tuple(_checked(flat[..., i], int(n), f"{name}[{i}]") for i, n in enumerate(sizes))


def _flat(array: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Flatten the trailing axes of a space's shape, keeping the leading ones of a batch."""
    leading = array.ndim - len(shape)
    if leading < 0 or array.shape[leading:] != shape:
        raise ValueError(f"{name} must have shape (..., {', '.join(map(str, shape))}), got {array.shape}")
    return array.reshape(*array.shape[:leading], math.prod(shape))


def _checked(value: np.ndarray, size: int, name: str) -> np.ndarray:
    if np.any((value < 0) | (value >= size)):
        raise ValueError(f"{name} must be in 0..{size - 1} (counted from 0), got {value}")
    return np.asarray(value, np.int32)
