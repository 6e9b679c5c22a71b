"""One greedy trial at a time with the belief kept at every step, for pictures; not for speed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from jaxpomdp.envs.host import HostWorld
from jaxpomdp.envs.world import UNIFORMS_PER_RESET, UNIFORMS_PER_STEP, World


class Mind(NamedTuple):
    """Who walks: ``begin(obs)`` and ``follow(belief, action, observation)`` give beliefs, ``act`` acts."""

    begin: Callable[[int], np.ndarray]
    follow: Callable[[np.ndarray, int, int], np.ndarray]
    act: Callable[[np.ndarray], int]


class Walk(NamedTuple):
    """A trial: int ``[T]`` states and observations; ``[T-1]`` actions and rewards; ``[T, N]`` beliefs."""

    states: np.ndarray
    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    beliefs: np.ndarray


def walk(world: World, mind: Mind, seed: int, trial: int, limit: int | None = None) -> Walk:
    """Walk one trial greedily; chance depends on seed, trial and step alone.

    Args:
        world: where.
        mind: who.
        seed: of the chance.
        trial: which of the many trials of that seed.
        limit: most actions; by default the world's.
    """
    host = HostWorld(world)
    state, observation = host.reset(np.random.default_rng((seed, trial, 0)).random(UNIFORMS_PER_RESET))
    states, seen, actions, rewards, beliefs = [state], [observation], [], [], [mind.begin(observation)]
    for t in range(1, (limit or world.step_limit) + 1):
        action = mind.act(beliefs[-1])
        uniforms = np.random.default_rng((seed, trial, t)).random(UNIFORMS_PER_STEP)
        state, observation, reward, over = host.step(state, action, uniforms)
        actions.append(action)
        rewards.append(reward)
        states.append(state)
        seen.append(observation)
        beliefs.append(mind.follow(beliefs[-1], action, observation))
        if over:
            break
    columns = (np.array(states), np.array(seen), np.array(actions), np.array(rewards))
    return Walk(*columns, np.stack(beliefs))


def meaning(world: World, walks: Iterable[Walk]) -> np.ndarray:
    """Return what each state of a learned model stands for: ``[N, world's states]``, rows that sum to one.

    ``meaning[n, s] = sum_t b_t(n) [s_t = s]``, normalised over ``s``: where the agent truly was, weighted by
    how much it believed to be in ``n``. States that were never believed in are spread over all of the world.
    """
    total = sum(w.beliefs.T @ np.eye(world.num_states)[w.states] for w in walks)
    total = np.asarray(total) + 1e-9
    return total / total.sum(axis=1, keepdims=True)
