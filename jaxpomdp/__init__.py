"""Learning to act in worlds that cannot be fully seen: action-conditioned HMMs with utility, in JAX."""
