"""Many copies of one world as a Gymnasium vector environment, stepped together on the device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from jaxpomdp._types import Array
from jaxpomdp.envs.gym_env import RENDER_MODES, check_render_mode, world_of
from jaxpomdp.envs.picture import frame
from jaxpomdp.envs.text import ansi
from jaxpomdp.envs.world import UNIFORMS_PER_RESET, UNIFORMS_PER_STEP, Step, World, reset, step


class _Copies(NamedTuple):
    """What is carried for each of ``E`` copies; ``tick`` counts every draw, ``steps`` those of the trial."""

    key: Array
    tick: Array
    state: Array
    observation: Array
    steps: Array
    over: Array


class _Advance(NamedTuple):
    """What one call brought: ``step`` before any reset, ``truncated``, and ``acted``: it was no reset."""

    step: Step
    truncated: Array
    acted: Array


def _uniforms(key: Array, tick: Array | int, count: int) -> Array:
    return jax.random.uniform(jax.random.fold_in(key, tick), (count,))


@jax.jit
def _begin(world: World, seeds: Array) -> _Copies:
    """Start one copy a seed."""

    def one(seed: Array) -> _Copies:
        key = jax.random.key(seed)
        state, observation = reset(world, _uniforms(key, 0, UNIFORMS_PER_RESET))
        return _Copies(key, jnp.int32(1), state, observation, jnp.int32(0), jnp.bool_(False))

    return jax.vmap(one)(seeds)


@partial(jax.jit, static_argnames="same_step")
def _advance(world: World, copies: _Copies, actions: Array, *, same_step: bool) -> tuple[_Copies, _Advance]:
    """Act in every copy, and begin anew where a trial is over: in this step, or in the next one."""

    def one(copy: _Copies, action: Array) -> tuple[_Copies, _Advance]:
        drawn = _uniforms(copy.key, copy.tick, UNIFORMS_PER_STEP + UNIFORMS_PER_RESET)
        after = step(world, copy.state, action, drawn[:UNIFORMS_PER_STEP])
        truncated = (copy.steps + 1 >= world.step_limit) & ~after.terminated
        over = after.terminated | truncated
        anew = over if same_step else copy.over
        fresh_state, fresh_observation = reset(world, drawn[UNIFORMS_PER_STEP:])
        following = _Copies(
            copy.key,
            copy.tick + 1,
            jnp.where(anew, fresh_state, after.state),
            jnp.where(anew, fresh_observation, after.observation),
            jnp.where(anew, 0, copy.steps + 1),
            over & ~anew,
        )
        return following, _Advance(after, truncated, ~copy.over)

    return jax.vmap(one)(copies, actions)


class WorldVectorEnv(VectorEnv):
    """Copies of one world; the draws of a copy depend on its seed and step, not on the other copies.

    ``reset(seed=n)`` gives copy ``i`` the seed ``n + i``, as Gymnasium's own vector environments do; a
    sequence gives each its own. When a trial is over the copy begins anew by itself, in the way that
    ``metadata["autoreset_mode"]`` declares:

    - ``NEXT_STEP`` (default): the last observation of the trial is returned as it is; the next call
      ignores the copy's action, returns its first observation, reward 0 and no flags.
    - ``SAME_STEP``: the first observation of the next trial is returned at once; the last of the old
      trial is in ``info["final_obs"]`` (mask ``"_final_obs"``), its hidden state in ``info["final_info"]``.

    ``info`` holds ``state``, the hidden states, and, where a trial is over, ``success`` (mask ``_success``).

    Args:
        world: a name or a world.
        num_envs: ``E``, how many copies.
        render_mode: None, ``"rgb_array"`` or ``"ansi"``.
        autoreset_mode: ``NEXT_STEP`` or ``SAME_STEP``, as a member of ``AutoresetMode`` or its value.
        **settings: of a world given by name.

    Raises:
        ValueError: ``num_envs`` is below 1, or a mode is unknown.
    """

    def __init__(
        self,
        world: str | World,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        mode = AutoresetMode(autoreset_mode)
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if mode is AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode must be NEXT_STEP or SAME_STEP, got DISABLED")
        check_render_mode(render_mode)
        self.world = world_of(world, settings)
        self.num_envs, self.render_mode, self.autoreset_mode = num_envs, render_mode, mode
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": 8, "autoreset_mode": mode}
        self.single_observation_space = gymnasium.spaces.Discrete(self.world.num_observations)
        self.single_action_space = gymnasium.spaces.Discrete(self.world.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._copies: _Copies | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin a trial in every copy; returns observations ``[E]`` and ``info``; ``options`` are unused."""
        copies = self._copies = _begin(self.world, self._seeds(seed))
        return _host(copies.observation, np.int64), {"state": _host(copies.state, np.int64)}

    def _seeds(self, seed: int | Sequence[int] | None) -> np.ndarray:
        if isinstance(seed, int | np.integer) or seed is None:
            super().reset(seed=None if seed is None else int(seed))
            first = int(self.np_random.integers(2**31)) if seed is None else int(seed)
            return (np.arange(self.num_envs) + first).astype(np.uint32)
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must be one number or {self.num_envs}, got {len(seed)}")
        return np.asarray(seed).astype(np.uint32)

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Act once in every copy, with actions ``[E]``.

        Returns:
            Observations, rewards, terminations and truncations, each ``[E]``, and ``info``.

        Raises:
            ValueError: before the first reset, or an action that the world lacks.
        """
        if self._copies is None:
            raise ValueError("reset must be called before step")
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        copies, advance = _advance(self.world, self._copies, self._checked(actions), same_step=same_step)
        self._copies = copies
        acted = _host(advance.acted, bool)
        terminated = _host(advance.step.terminated, bool) & acted
        truncated = _host(advance.truncated, bool) & acted
        reward = np.where(acted, _host(advance.step.reward, np.float64), 0.0)
        info: dict[str, Any] = {"state": _host(copies.state, np.int64)}
        over = terminated | truncated
        if over.any():
            info |= self._final(advance, terminated & (reward > self.world.success_above), over)
        return _host(copies.observation, np.int64), reward, terminated, truncated, info

    def _checked(self, actions: Any) -> np.ndarray:
        array = np.asarray(actions)
        if array.shape != (self.num_envs,) or np.any((array < 0) | (array >= self.world.num_actions)):
            expected = f"shape ({self.num_envs},) with values in 0..{self.world.num_actions - 1}"
            raise ValueError(f"actions must have {expected}, got {actions}")
        return array.astype(np.int32)

    def _final(self, advance: _Advance, success: np.ndarray, over: np.ndarray) -> dict[str, Any]:
        """Return what ``info`` says where a trial is over."""
        ended = {"success": success, "_success": over.copy()}
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            return ended
        last = _host(advance.step.observation, np.int64)
        final = np.full(self.num_envs, None, dtype=object)
        final[over] = last[over]
        ended |= {"state": _host(advance.step.state, np.int64), "_state": over.copy()}
        return {"final_obs": final, "_final_obs": over, "final_info": ended, "_final_info": over.copy()}

    def render(self) -> tuple[Any, ...] | None:
        """Return one picture or text a copy."""
        if self.render_mode is None or self._copies is None:
            return None
        draw = frame if self.render_mode == "rgb_array" else ansi
        states, observations = _host(self._copies.state, int), _host(self._copies.observation, int)
        pairs = zip(states.tolist(), observations.tolist(), strict=True)
        return tuple(draw(self.world, state, observation=observation) for state, observation in pairs)


def _host(array: Array, dtype: Any) -> np.ndarray:
    return np.array(array, dtype)
