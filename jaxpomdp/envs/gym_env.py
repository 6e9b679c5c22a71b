"""One world as a Gymnasium environment."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np

from jaxpomdp.envs.host import HostWorld
from jaxpomdp.envs.picture import frame
from jaxpomdp.envs.registry import make
from jaxpomdp.envs.text import ansi
from jaxpomdp.envs.world import UNIFORMS_PER_RESET, UNIFORMS_PER_STEP, World

RENDER_MODES = ("rgb_array", "ansi")


def world_of(world: str | World, settings: dict[str, Any]) -> World:
    """Return the world that is meant by a name with settings, or the world itself.

    Raises:
        ValueError: the name is unknown, or a world comes with settings.
    """
    if isinstance(world, str):
        return make(world, **settings)
    if settings:
        raise ValueError(f"settings go with the name of a world, got a world and {sorted(settings)}")
    return world


def check_render_mode(mode: str | None) -> None:
    """Check that a way of rendering is known.

    Raises:
        ValueError: it is not.
    """
    if mode is not None and mode not in RENDER_MODES:
        raise ValueError(f"render_mode must be None or one of {RENDER_MODES}, got {mode!r}")


class WorldEnv(gymnasium.Env):
    """A world for one agent: ``Discrete`` observations and actions.

    ``info`` holds ``state``, the hidden state, for judges and not for agents, and at the end of a trial
    ``success``. Seeded by ``reset(seed=...)``.

    Args:
        world: a name or a world.
        render_mode: None, ``"rgb_array"`` or ``"ansi"``.
        **settings: of a world given by name.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": 8}

    def __init__(self, world: str | World, *, render_mode: str | None = None, **settings: Any) -> None:
        check_render_mode(render_mode)
        self.world = world_of(world, settings)
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Discrete(self.world.num_observations)
        self.action_space = gymnasium.spaces.Discrete(self.world.num_actions)
        self._host = HostWorld(self.world)
        self._state, self._observation, self._steps = 0, 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Begin a trial; returns the observation and ``info``. ``options`` are not used."""
        super().reset(seed=seed)
        self._steps = 0
        self._state, self._observation = self._host.reset(self.np_random.random(UNIFORMS_PER_RESET))
        return np.int64(self._observation), {"state": self._state}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        """Act once; returns observation, reward, terminated, truncated and ``info``.

        Raises:
            ValueError: the world has no such action.
        """
        after = self._host.step(self._state, int(action), self.np_random.random(UNIFORMS_PER_STEP))
        self._state, self._observation = after.state, after.observation
        self._steps += 1
        truncated = self._steps >= self.world.step_limit and not after.terminated
        info: dict[str, Any] = {"state": after.state}
        if after.terminated or truncated:
            info["success"] = after.terminated and after.reward > self.world.success_above
        return np.int64(after.observation), after.reward, after.terminated, truncated, info

    def render(self) -> Any:
        """Return the map with the agent and what it sees: pixels ``[height, width, 3]``, or text."""
        if self.render_mode is None:
            return None
        draw = frame if self.render_mode == "rgb_array" else ansi
        return draw(self.world, self._state, observation=self._observation)
