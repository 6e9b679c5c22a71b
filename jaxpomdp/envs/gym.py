"""The worlds as Gymnasium environments: ``register`` names them, and importing this module calls it.

Gymnasium (1.0 and later) loads no plug-ins by itself; it imports the module that comes before a colon::

    import gymnasium
    env = gymnasium.make("jaxpomdp.envs.gym:jaxpomdp/Maze89-v0", render_mode="rgb_array")
    envs = gymnasium.make_vec("jaxpomdp/TMaze-v0", num_envs=64, length=20)

or, as its documentation advises, ``gymnasium.register_envs(jaxpomdp.envs.gym)`` after importing this module.
It imports neither the worlds nor JAX: Gymnasium does when an environment is made.

Every environment takes ``render_mode`` (``"rgb_array"`` or ``"ansi"``) and the settings of its world, such as
``step_limit``; ``jaxpomdp/World-v0`` takes ``world``, a name for :func:`jaxpomdp.envs.registry.make` or a
world. A trial that reaches the step limit without an end is truncated; one that ends there is terminated.
"""

from __future__ import annotations

IDS = {
    "Hallway": "hallway",
    "HallwayNoise": "hallway-noise",
    "Maze57": "maze57",
    "Maze57Noise": "maze57-noise",
    "Maze89": "maze89",
    "Maze89Noise": "maze89-noise",
    "TMaze": "tmaze",
    "TMazeNoise": "tmaze-noise",
    "TigerGrid": "tiger-grid",
    "TigerGridNoise": "tiger-grid-noise",
    "World": None,
}
"""Gymnasium names (between ``jaxpomdp/`` and ``-v0``) and the worlds they stand for."""


def register() -> None:
    """Register every world with Gymnasium as ``jaxpomdp/NAME-v0``; calling it again changes nothing."""
    import gymnasium

    for name, world in IDS.items():
        identifier = f"jaxpomdp/{name}-v0"
        if identifier not in gymnasium.registry:
            gymnasium.register(
                identifier,
                entry_point="jaxpomdp.envs.gym_env:WorldEnv",
                vector_entry_point="jaxpomdp.envs.gym_vector:WorldVectorEnv",
                kwargs={} if world is None else {"world": world},
            )


register()
