"""Gymnasium spaces as channels."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.envs.spaces import ActionSpec, actions_of, channels_of, encode

KINDS = [
    spaces.Discrete(5),
    spaces.Discrete(3, start=-2),
    spaces.MultiDiscrete([2, 5, 3]),
    spaces.MultiDiscrete(np.array([[2, 5], [3, 4]])),
    spaces.MultiBinary(3),
    spaces.MultiBinary((2, 2)),
    spaces.Box(-1, 1, (3,)),
    spaces.Box(0, 255, (2, 3), np.uint8),
    spaces.Box(-np.inf, np.inf, ()),
]
NESTED = spaces.Dict({"where": spaces.Discrete(4), "see": spaces.Tuple(KINDS[2:5]), "feel": KINDS[6]})


def test_channels_of_each_kind() -> None:
    assert channels_of(spaces.Discrete(5))[0][:2] == ("categorical", 5)
    assert [c[:2] for c in channels_of(spaces.MultiDiscrete([2, 5]))] == [
        ("categorical", 2),
        ("categorical", 5),
    ]
    assert [c.size for c in channels_of(spaces.MultiBinary((2, 2)))] == [2] * 4
    assert [c[:2] for c in channels_of(spaces.Box(-1, 1, (2, 3)))] == [("gaussian", 6)]


def test_nested_channels_say_where_they_come_from() -> None:
    names = [channel.name for channel in channels_of(NESTED)]
    assert names == [f"observation[{key!r}]" for key in NESTED.spaces if key == "feel"] + [
        *(f"observation['see'][0][{i}]" for i in range(3)),
        *(f"observation['see'][1][{i}]" for i in range(4)),
        *(f"observation['see'][2][{i}]" for i in range(3)),
        "observation['where']",
    ]


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([*KINDS, NESTED]), st.integers(0, 2**31 - 1))
def test_samples_encode_into_their_channels(space: spaces.Space, seed: int) -> None:
    space.seed(seed)
    channels, arrays = channels_of(space), encode(space.sample(), space)
    assert len(channels) == len(arrays)
    for channel, array in zip(channels, arrays, strict=True):
        if channel.kind == "categorical":
            assert (array.dtype, array.shape) == (np.int32, ())
            assert 0 <= array < channel.size
        else:
            assert (array.dtype, array.shape) == (np.float32, (channel.size,))


@settings(max_examples=30, deadline=None)
@given(st.sampled_from([*KINDS, NESTED]), st.integers(0, 2**31 - 1))
def test_a_batch_encodes_as_its_elements_do(space: spaces.Space, seed: int) -> None:
    space.seed(seed)
    elements = [space.sample() for _ in range(3)]
    batched = gymnasium.vector.utils.concatenate(
        space, elements, gymnasium.vector.utils.create_empty_array(space, n=3)
    )
    assert batch_space(space, 3).contains(batched)
    one_by_one = [encode(element, space) for element in elements]
    for together, apart in zip(encode(batched, space), zip(*one_by_one, strict=True), strict=True):
        np.testing.assert_array_equal(together, np.stack(apart))


def test_components_keep_their_order() -> None:
    arrays = encode(np.array([[1, 4], [0, 3]]), spaces.MultiDiscrete(np.array([[2, 5], [3, 4]])))
    assert [int(array) for array in arrays] == [1, 4, 0, 3]
    assert int(encode(-1, spaces.Discrete(3, start=-2))[0]) == 1


@pytest.mark.parametrize(
    ("value", "space", "message"),
    [
        (5, spaces.Discrete(5), r"observation must be in 0\.\.4"),
        (-1, spaces.Discrete(5), r"observation must be in 0\.\.4"),
        ([0, 2], spaces.MultiBinary(2), r"observation\[1\] must be in 0\.\.1"),
        ([0.0, np.nan], spaces.Box(-1, 1, (2,)), "observation must be finite"),
        ([0.0, 1.0, 2.0], spaces.Box(-1, 1, (2,)), r"must have shape \(\.\.\., 2\), got \(3,\)"),
        ({"a": 9}, spaces.Dict({"a": spaces.Discrete(2)}), r"observation\['a'\] must be in 0\.\.1"),
    ],
)
def test_bad_observations_are_refused(value: object, space: spaces.Space, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        encode(value, space)


def test_other_spaces_are_refused() -> None:
    text = spaces.Dict({"a": spaces.Text(5)})
    for refused in (lambda: channels_of(text), lambda: encode({"a": "x"}, text)):
        with pytest.raises(
            TypeError, match=r"observation\['a'\] must come from a space that is Discrete, Multi"
        ):
            refused()
    with pytest.raises(ValueError, match="must have at least one component"):
        channels_of(spaces.Box(0, 1, (0,)))


def test_actions() -> None:
    assert actions_of(spaces.Discrete(3, start=2)) == ActionSpec(3, 2)
    with pytest.raises(TypeError, match="the action space must be Discrete, got Box"):
        actions_of(spaces.Box(-1, 1, (2,)))
