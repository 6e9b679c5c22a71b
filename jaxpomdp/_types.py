"""The time-line, the letters, and the batch of trials that everything refers to.

::

    state     s0 --a0--> s1 --a1--> s2 ... --a(T-2)--> s(T-1)
    emits     o0         o1         o2                 o(T-1)
    reward        r0         r1                            (r[t] is paid for action[t], taken in s[t])
    return    R[t] = r[t] + gamma R[t+1];  R of a terminal last step = 0

``actions[t]`` drives ``s[t] -> s[t+1]``; at the last step of a trial it drives nothing and is ignored.

Letters, in docstrings and shapes: ``S`` seeds (models), ``B`` rows of trials, ``T`` steps, ``N`` states
(production states), ``M`` tree nodes, ``A`` actions, ``O`` discrete observations, ``D`` dimensions of one.

A row of a batch is a *tape*: one trial, or several laid end to end. ``start`` marks the first step of each;
a start forgets the past, so a tape of many short trials costs what its steps cost and no padding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp

Array = jax.Array
Class = TypeVar("Class")


@dataclass_transform(frozen_default=True)
def pytree(cls: type[Class]) -> type[Class]:
    """Make a class a frozen dataclass whose fields are pytree children."""
    return jax.tree_util.register_dataclass(dataclass(frozen=True)(cls))


class Chain(NamedTuple):
    """What inference knows of a model: ``log_init[N]`` and ``log_trans[A, N, N]`` (row: from, column: to)."""

    log_init: Array
    log_trans: Array


class Posterior(NamedTuple):
    """What inference gives back for one tape.

    ``log_evidence[]`` sums over the steps; ``gamma[T, N]`` is zero at padding; ``xi[A, N, N]`` holds expected
    transitions under each action; ``initial[N]`` is the sum of ``gamma`` over the starts.
    """

    log_evidence: Array
    gamma: Array
    xi: Array
    initial: Array


@pytree
class TrialBatch:
    """Experience on the time-line above; every array has leading axes ``[..., T]``.

    Attributes:
        observations: tuple with one array per channel, int ``[..., T]`` or float ``[..., T, D]``.
        actions: int ``[..., T]``.
        rewards: float ``[..., T]``, paid for ``actions``.
        returns: float ``[..., T]``, discounted return from each step on.
        valid: bool ``[..., T]``, the step exists (False = padding; it contributes nothing, exactly).
        start: bool ``[..., T]``, the step is the first of a trial.
        terminated: bool ``[..., T]``, the world ended the trial at this step (else it was cut off).
        observed: bool ``[..., T]``, the observation is there (False = missing step).
        has_return: bool ``[..., T]``, the return is modelled at this step.
    """

    observations: tuple[Any, ...]
    actions: Array
    rewards: Array
    returns: Array
    valid: Array
    start: Array
    terminated: Array
    observed: Array
    has_return: Array


def last_steps(valid: Array, start: Array) -> Array:
    """Mark the last step of every trial, ``bool[..., T]``: what follows is a start, padding or nothing."""
    beyond = jnp.ones_like(start[..., :1])
    following = jnp.concatenate([start[..., 1:] | ~valid[..., 1:], beyond], axis=-1)
    return valid & following
