"""Kernels: pure functions of arrays for one unbatched sequence; lift them with ``jax.vmap``."""
